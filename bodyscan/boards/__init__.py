"""Calibration boards found in images, whole or in part, and their corners to a fraction of a pixel.

Start with detection; charuco, aprilgrid and checkerboard find one kind each (board_map, regions),
corners refines. board_layout: what is printed. view: what was found; detection_failure: why not.
"""
