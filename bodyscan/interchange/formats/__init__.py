"""The formats in which calibrated cameras are read and written: one file each, with its FORMAT."""
