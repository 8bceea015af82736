"""Mathematics without files or images: poses, cameras, light sheets, least squares.

transforms: poses. camera with its lenses, and both as a table: camera_tables.
Light sheets: light_planes (one plane per stripe, Eq. 6), bowed_sheets and lens_sheets (smooth in s),
light_sheets (any of them).
least_squares, linear_gaussian, robust: estimation. uncertainty: of a calibration.
"""
