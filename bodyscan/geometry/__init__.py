"""Mathematics without files or images: poses, cameras, light sheets, fitting.

Poses: transforms, pose_covariance. Cameras: camera, lenses (one file each), camera_tables
(for compiled loops), camera_fields (for files), pixel_rays, quadratic_table, ray_uncertainty,
visibility, crop. Light sheets: light_planes (one plane per stripe, Eq. 6), smooth_sheets with
bowed_sheets, lens_sheets with lens_points, projector_sheets; sheet_table and sheet_arrays (for
compiled loops and for files), ray_depths (where a ray meets a sheet). Fitting: least_squares,
robust, linear_gaussian.
"""
