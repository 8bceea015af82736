"""Align range images where they overlap, and take the subject's motion out of them.

Read in this order: together (the whole), icp (rounds that align the pairs of one person, each pair
moved as a whole; open3d_registration does the same with Open3D), matching (which points are the
same spot), overlaps and overlap_equations (what overlaps ask for, and the joint step), sway_prior
(how far a subject is believed to move).

A person who moves while pair after pair sees them: following (motion found and taken out),
motion_sigmas (what stays unknown), body_cells and cell_evidence, moments (how motion
at one moment correlates with the next), body_motion (everything in one solve), breath, limbs,
part_names and body_parts (the same in an operator's words), bending (range images carried to one
moment).

What is not motion: pole_steps and place_evidence (poles that stand off), pair_drift (what every
scan shows), object_refinement (an object that stands still).
"""
