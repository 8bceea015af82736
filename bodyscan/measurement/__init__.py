"""Measure a body mesh.

measurements: stature, girths, volume, area (outline: girths across filled surface). head: its top
under hair.
"""
