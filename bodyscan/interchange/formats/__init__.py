"""The formats in which calibrated cameras are read and written: one file each, named so, that has
FORMAT."""
