"""Files for other programs.

scan (a scan's mesh in several formats and versions) and rig (a calibration). body_file writes one body
and the JSON beside it; formats holds one file a format, found by registry, described by body_format;
those of rigs are in bodyscan.interchange. e57: each pair's raw cloud. defacing, with neck: without a
face. decimal_text: numbers as text, many at a time.
"""
