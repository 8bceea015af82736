"""Compare results with known values: simulated bodies, other scans, artefacts of an acceptance test.

acceptance: an acceptance test, of artefacts (fitted by primitives). body and surface: of scans.
"""
