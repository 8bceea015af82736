"""Scans (`scan`), rigs (`rig`) and raw clouds (`e57`) as files for other programs."""
