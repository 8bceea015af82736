"""Triangulation: from a pair's stripe map to a range image.

triangulation within scan_volume gives a range_image.
"""
