"""Captures on disk: folders, the images in them, and what is wrong with either.

Read in this order: folder (which image of which pair and shot lies where; listing, captures_file;
timing: when), images (read and checked; image_header, image_faults, grey_png, grey_levels,
exposures), check (a look at all of it before any work; unlisted_images), pattern_files (images for
projectors).
"""
