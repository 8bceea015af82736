"""Triangle meshes of bodies: the types (`body`), topology, repair, decimation, slices,
and what part of a body each piece of a slice is (`body_parts`).

ply: files. surface_nets: a mesh from signed distances. nearest_surface, depth_buffer: what
is near, and what is visible.
"""
