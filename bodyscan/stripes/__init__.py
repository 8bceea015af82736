"""Stripe codes: what is projected, and where in an image each stripe is seen.

Read in this order: stripe_code (what a code is), codes (one file each), patterns (images to project),
decoding (images to a stripe map), stripe_map (what that is).

What decodes: bit_patterns with bit_words, phase_steps, line_sweep and index_image decode the images of
their kind, laid out by scan_lines; phase_waves those of waves of several periods, with wave and waves
(what they are, their phases), wave_noise, projector_response, phase_order and phase_smoothing.
sequence_checks and stripe_order say whether images add up, and which is wrong; usable_pixels, with
grey_noise and indirect_light, which pixels count; stripe_limits, which stripes are worth it. boundaries
finds where stripes end, albedo_edges puts that right at edges of the surface's brightness,
stripe_coordinates interpolates between them, code_lines where there are none; pixel_stripes does all
that for codes that tell s at each pixel. line_bands: boundaries of some lines alone. bit_clarity,
clear_changes and boundary_scatter hold what was decoded against its noise. comb and one_moment: what
moved while the images were taken.
"""
