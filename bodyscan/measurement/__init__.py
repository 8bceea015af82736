"""Measure a body mesh, as far as shows that it is fit for use: stature, girths, volume, area.

measurements (all of them), body_frame (which way the body faces), outline (unmeasured parts of a
slice), head (where it ends under the hair).
"""
