"""Triangle meshes and the body's own: types, soundness, repair, smaller versions, files.

Read in this order: body (the types), half_edges and topology (is it a closed surface), repair (made
one), bricks and surface_nets (the zero set of values on a grid), scene (rays and nearest points),
decimation, holes and rings (what is odd about it), ply.
"""
