"""Bring all pairs into one frame, by boards that they saw together.

Read in this order: rig_solve (the whole), view_graph (who shares which board with whom),
joint_solve (pycolmap), full_solve with normal_equations (the last steps, over our own cameras),
consistent_solve and inconsistent_views (views that cannot be true), rig_lenses, board_shape (boards
as they really are), references and nominal_size, rig_frame, honest_covariance, rig_calibration (the
result), storage and soundness (files on disk).

Remarks on the result: advice and more_shots, halves (the rig solved twice), board_checks and
board_appearance (boards that differ from their description), seen_corners. drift: what has moved
since.
"""
