"""Rigid alignment of range images, and poles displaced since the calibration.

icp: the pairs' poses, from overlaps (matched by matching), the calibration and sway_prior.
displaced_poles, pose_evidence: poles that moved. open3d_registration: the same with Open3D.
"""
