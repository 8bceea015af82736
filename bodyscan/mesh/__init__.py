"""Triangle meshes of bodies: types (`body`), topology, repair, decimation, slices, PLY files."""
