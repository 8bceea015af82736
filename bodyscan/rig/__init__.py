"""The rig file: what a rig consists of, how its images are named, and what is wrong with it, by line.

Read in this order: rig_file (read and written), rig (all of it), pair, known, board, reference,
rig_frame, frame_names, templates and capture_folder (file names), consistency and sizes (what must
fit together).
"""
