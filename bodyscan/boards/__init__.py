"""Calibration boards found in images, whole or in part, and their corners to a fraction of a pixel.

Read in this order: detection (all boards in an image), charuco and checkerboard (one kind each),
corners (lines fitted to the edges around each), view (what was found), board_layout (where corners and
markers lie on it), board_map (where a print appears in an image), regions (where to look for one),
appearance (white on black, or mirrored), unfound (what shows where no board was found). aprilgrid and
numbered_corners: boards whose corners somebody else numbered.
"""
