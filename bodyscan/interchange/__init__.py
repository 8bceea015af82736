"""Cameras and their poses in the files of other programs: one module per format, in `formats`.

rig_format: what a format provides. foreign_file: a file's numbers, checked. found_camera: the result.
"""
