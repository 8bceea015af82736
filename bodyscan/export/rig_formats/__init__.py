"""The formats in which a calibrated rig is written: one file each, named so, that has FORMAT."""
