"""Triangle meshes of bodies: the types (`body`), topology, repair, slices, sliced_parts (what
each piece of a slice is), body_frame (where a body stands, and which way it faces).

ply: our files. surface_file: other programs'. surface_nets: a mesh from signed distances.
depth_buffer: what is visible.
"""
