"""Stripe codes: what is projected, and which stripe each pixel of an image shows.

stripe_code defines what a code is, `codes` has one file for each, decoding turns a sequence of
images into a stripe_map. Decoders: gray (bits), phase (waves), numbered_stripes (swept line,
stripe-index image). They share scan_lines (images laid out across the stripes), grey_noise,
usable_pixels, boundaries and albedo_edges (where stripes end), stripe_coordinates (s between
boundaries) and stripe_limits.
"""
