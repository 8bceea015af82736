"""Measurements of a body mesh that show it fit for use: stature, girths of slices, volume, area.

measurements (all of them), body_frame (which way the body faces), outline (what of a slice nobody
measured), head (where it ends under the hair).
"""
