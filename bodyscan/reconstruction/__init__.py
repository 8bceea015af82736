"""Triangulation: from a pair's stripe map to a range image."""
