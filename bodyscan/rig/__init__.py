"""The rig file (`rig`): what a rig consists of, and its mistakes by line.

board, pair, rig_frame: its parts. frame_names, templates: how images are named.
"""
