"""Measure a body mesh: stature, girths, volume, area, the top of the head under hair."""
