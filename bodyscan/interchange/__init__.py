"""Cameras and their poses in the files of other programs: one module per format, in `formats`."""
