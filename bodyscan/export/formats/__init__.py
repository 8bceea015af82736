"""The formats in which a body is written: one file each, named as the format, with its FORMAT."""
