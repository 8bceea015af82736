"""Measure a body mesh.

measurements: stature, girths, volume, area (outline: across filled surface). head: its top.
"""
