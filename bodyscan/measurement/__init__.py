"""Measure a body mesh.

measurements: stature, girths, volume, area (outline: across filled surface). head: its top.
named: measures by name, each a file in `measures`, from landmarks and plane sections; posture; changes.
"""
