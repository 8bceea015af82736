"""Calibrate a rig of projector-camera pairs and fuse its scans of a person into a body model."""

__version__ = "0.1.0"
