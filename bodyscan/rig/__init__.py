"""The rig file: what a rig consists of, how its images are named, and what is wrong with it, by line.

Read in this order: rig_file (read and written), rig (all of it), pair, known, board,
rig_frame, frame_names and templates (file names), consistency (what must fit together).
"""
