"""One pair: its camera, and where in space its projector's light goes.

Start with pair. The camera: zhang, camera, lens_choice. Its light: striped_view, stripe_agreement,
boundary_points, light_sheets. Both at once: joint_refinement. Calibrated elsewhere: known_pair.
"""
