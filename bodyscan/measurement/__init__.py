"""Measurements of a body mesh that show it fit for use: stature, girths of slices, volume, area."""
