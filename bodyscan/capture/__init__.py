"""A rig's devices, and a sequence projected and photographed by them.

cameras, projectors (by kind, one file each), devices (all of a rig, open); exposure (what is found
before), session (in which order, and a shot taken and written). Nothing here is imported by those
whose images another program takes.
"""
