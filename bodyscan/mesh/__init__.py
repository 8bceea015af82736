"""Triangle meshes and the body's own: types, soundness, repair, smaller versions, files.

Read in this order: body (the types; regions: skin or what covers it), half_edges and topology (is it a
closed surface), repair and slivers (made one), bricks and surface_nets (the zero set of values on a
grid), scene and depth_buffer (rays, nearest points, what hides what), decimation, slices, holes and
rings (what is odd about it), ply.
"""
