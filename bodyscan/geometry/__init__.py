"""Mathematics that knows of no file and no image: poses, cameras, sheets of light, fitting.

Poses: transforms, velocity, pose_covariance. Cameras: camera, lenses (one file each), camera_tables
(as compiled loops see them), camera_fields, pixel_rays, quadratic_table, ray_uncertainty, visibility,
crop. Sheets of light: light_planes (one plane a stripe, Eq. 6), smooth_sheets with bowed_sheets,
lens_sheets with lens_points, projector_sheets; sheet_table and sheet_arrays (as loops and files hold
them), ray_depths (where a ray meets them). Fitting: least_squares, robust, scaled_systems.
"""
