"""The commands' workflows, stage by stage: each reads as a table of contents.

Calibrating a rig: find_boards (boards, cameras, board poses), decode, calibrate_rig, rig_remarks,
import_rig, refine_rig. Checking it: check_rig by check_boards or check_scans, accept_rig, evaluate.
Scanning: preparation, range_images, fuse_range_images, scan_person.
"""
