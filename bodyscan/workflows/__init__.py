"""The commands' workflows, stage by stage: each reads as a table of contents.

Calibrating a rig: find_boards (boards, cameras, board poses), decode, calibrate_rig,
import_rig. Checking it: check_rig, accept_rig, evaluate. Scanning: range_images,
scan_person.
"""
