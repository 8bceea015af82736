"""Rigid alignment of range images: matching, multiway ICP, and poles displaced since calibration."""
