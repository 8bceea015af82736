"""Captures on disk: folders, the images in them, and what is wrong with either.

Read in this order: folder (where each image of each pair and shot lies; listing, captures_file;
timing: when), images (reading and checking; image_header, image_faults, grey_png, grey_levels,
exposures), check (a quick look at everything before any work; unlisted_images), pattern_files
(images for projectors).
"""
