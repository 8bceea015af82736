"""Files for other programs.

scan (a scan's mesh in several formats and versions) and rig (a calibration). body_file writes one
body and the JSON beside it; formats holds one file per format, found by a registry and described by
body_format; those of rigs are in bodyscan.interchange. e57: each pair's raw cloud. defacing, with
neck: removing the face. decimal_text: many numbers as text at once.
"""
