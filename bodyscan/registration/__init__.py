"""Bring all pairs into one frame, by boards that they saw at the same moment.

Read in this order: rig_solve (the whole), view_graph, joint_solve, view_consistency, board_motion,
board_shape, rig_lenses, references, rig_frame, cluster_covariance, rig_calibration (the result),
storage, sanity_checks. Checks: board_checks, drift, calibration_verdict. What to do next: advice.
"""
