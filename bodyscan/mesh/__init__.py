"""Triangle meshes and those of bodies: types, soundness, repair, smaller versions, files.

Read in this order: body (the types; regions: skin or what covers it), half_edges and topology
(whether a surface is closed), repair and slivers (making it so), bricks and surface_nets (the zero
set of values on a grid), scene and depth_buffer (rays, nearest points, what hides what),
decimation, slices, holes and rings (oddities of a mesh), ply.
"""
