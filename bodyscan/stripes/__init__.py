"""Stripe codes: what is projected, and where in an image each stripe is seen.

Read in this order: stripe_code (what a code is), codes (one file each), patterns (images to
project), decoding (images to a stripe map), stripe_map (the result).

Decoders: bit_patterns with bit_words, phase_steps, line_sweep and index_image, for images laid out
by scan_lines; phase_waves for waves of several periods, with wave and waves (what they are, their
phases), wave_noise, projector_response, phase_order and phase_smoothing. sequence_checks and
stripe_order say whether images are consistent, and which is wrong; usable_pixels, with grey_noise
and indirect_light, which pixels count; stripe_limits, which stripes are wanted. boundaries finds
where stripes end, albedo_edges corrects that at edges of the surface's brightness,
stripe_coordinates interpolates between boundaries, code_lines fills in where there are none;
pixel_stripes does all that for codes that give s at each pixel. line_bands: boundaries of some
lines only. bit_clarity, clear_changes and boundary_scatter compare what was decoded with its noise.
"""
