"""The rig file: what a rig consists of, how its images are named, and its mistakes line by line.

Read in this order: rig_file (reading and writing), rig (the whole), pair, known, board, reference,
rig_frame, frame_names, templates and capture_folder (file names), consistency and sizes (what must
fit together).
"""
