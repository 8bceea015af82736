"""Files for other programs: `scan` (a body_file in one of `formats`), `rig`, raw clouds (`e57`).

defacing: removes the face before a body is passed on. texture: a body's colours in an image.
"""
