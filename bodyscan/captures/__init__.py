"""Captures on disk.

folder: where each image lies (captures_file, listing). images: reads them (image_header, grey_png).
check: a quick check of both. pattern_files: what the projectors show.
"""
