"""Cameras and their poses as other programs write them: each format is read and written in one
file.

Read in this order: rig_format (what a format is, and the registry), found_camera (what is read),
foreign_file (a file, its numbers checked, its errors by line; toml_cameras), formats.
"""
