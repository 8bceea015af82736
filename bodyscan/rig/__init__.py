"""The rig file (`rig`): what a rig consists of, and its mistakes by line.

board, pair, gauge (what fixes frame and size), devices (that take images): its parts.
frame_names, templates: how images are named.
"""
