"""Calibration boards found in images, whole or in part, and their corners to a fraction of a pixel.

Read in this order: detection (all boards in an image), charuco and checkerboard (one kind each),
corners (a model of the image around each corner), view (what was found), board_layout (where
corners and markers lie on the board), board_map (where a print appears in an image), regions (where
to look for one), appearance (white on black, or mirrored), unfound (what an image shows instead of
the board). aprilgrid and numbered_corners: boards whose corners are numbered by Kalibr's convention
or by another program.
"""
