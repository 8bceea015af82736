"""Workflows behind the commands, stage by stage: each reads as a table of contents.

Building a rig: check_rig, find_boards (boards, cameras and the pose of each view), decode,
calibrate_rig, rig_remarks, import_rig, refine_rig, draw_sigma_map. Maintaining it: check_boards,
check_scans. Scanning: preparation, range_images, fuse_range_images, scan_person, scan_folder,
write_report. Comparing with known values: accept_rig with read_artefacts, evaluate.
"""
