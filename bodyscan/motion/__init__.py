"""Non-rigid motion of a person between the pairs' captures: estimated, removed, and reported.

person_alignment: the whole. estimation: poses and motion in turn; body_motion: the motion
and what remains of it, of body_cells, body_parts and breath, by motion_kinds, temporal_modes and
cell_equations. warping: removes it. person_motion: reports it. object_refinement: for rigid objects.
"""
