"""Compare results with known values: simulated bodies, other scans, artefacts of an acceptance test."""
