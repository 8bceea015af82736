"""Range images brought together where they overlap, and the subject's motion taken out of them.

Read in this order: together (all of it), icp (the rounds that bring the pairs of one person together,
each pair moved as a whole; open3d_registration does the same by Open3D), matching (which points are the
same spot), overlaps and overlap_equations (what these ask for, and the joint step), sway_prior (how
far a subject is believed to move).

Who moves while pair after pair sees them: following (motion found and taken out), body_cells and
cell_evidence, cell_speeds, moments (what the person does at one moment tells of the next), body_motion
(all of it in one solve), breath, limbs, part_names and body_parts (the same in an operator's words),
bending (range images carried to one moment).

What is not motion: pole_steps and place_evidence (poles that stand off), pair_drift (what every scan
says), oblique_light (skin), object_refinement (an object that stands still).
"""
