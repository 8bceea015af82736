"""From range images of one person to a body cloud and a closed mesh.

Read in this order: scan (what it gives), cleaning (removes what is not the subject), merging
(smoothing, with quadratic_fit; thinning; evidence; brightness; averaging),
pose_variance (what the rig adds to each point's sigma), regions and roughness (skin, hair, cloth),
meshing (signed_distances, hole_filling with harmonic_filling, free_space and crown, support with
point_columns; surface_check), scan_verdict (whether it is good: contradictions, seams,
floor), storage, scan_facts. Workflows say in which order they work.
"""
