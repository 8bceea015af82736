"""One pair: its camera, and where in space its projector's light goes.

Read in this order: pair (fits all of a pair's light), zhang and camera (Table 1 from boards),
board_views and board_form (what is seen of a board, and what may be unknown of it), lens_choice;
striped_view and boundary_points (stripe boundaries on boards of known pose, Eq. 18), light_planes
(the chapter's free planes, Eq. 15-18), sheet_fit (smooth sheets), light_sheets (every model tried),
model_selection and held_out (held-out boards choose), joint_refinement and refinement_choice
(corners and stripes in one solve, where that is better).

stripe_agreement: whether the projector moved. coverage and ray_uncertainty: what the boards did not
reach. pinhole_projector and fitted_projector: the projector as a camera. known_pair: pairs
calibrated elsewhere.
"""
