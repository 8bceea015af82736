"""All pairs in one frame, by boards that they saw together.

Read in this order: rig_solve (all of it), view_graph (who shares which board with whom),
joint_solve (pycolmap), full_solve with normal_equations (its last steps, over our own cameras),
consistent_solve and inconsistent_views (views that cannot be true), rig_lenses, board_shape (boards
as they are), references and nominal_size, rig_frame, honest_covariance, rig_calibration (the outcome),
storage and soundness (on disk).

What is said of it: advice and more_shots, halves (the rig placed twice), board_checks and
board_appearance (boards that are not as described), seen_corners. drift: what moved since.
"""
