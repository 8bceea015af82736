"""One pair: its camera, and where in space its projector's light goes.

Start with pair. The camera: camera, from board_views, started by zhang; its lens: lens_selection. Its
light: boundary_points, sheet_selection (sheet_fit, model_selection). Both at once: joint_refinement.
known_pair: calibrated elsewhere. projector_camera: for other programs.
"""
