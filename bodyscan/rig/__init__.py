"""The rig file (`rig`, read by rig_file): what a rig consists of, and its mistakes by line.

board, pair, rig_frame: its parts; consistency: whether they fit. frame_names, templates: how images
are named.
"""
