"""Files whose tests take seconds each, the longest first: `make test-quick` leaves them out.

Whole runs begin with them, and those that need the simulated workspace stand next to those that do
not, so that no worker makes another wait: neither for the workspace nor at the end.
"""

SLOW = (
    "workflows/test_reports.py",
    "workflows/test_real_captures.py",
    "workflows/test_light_chosen.py",
    "workflows/test_codes_calibrated.py",
    "workflows/test_bad_input.py",
    "workflows/test_batch.py",
    "laboratory/test_reproduce.py",
    "workflows/test_check_calibration.py",
    "workflows/test_example_scan.py",
    "workflows/test_whole_way.py",
    "workflows/test_import_rig.py",
    "workflows/test_any_subset.py",
    "examples/test_examples.py",
    "jobs/test_resuming.py",
    "jobs/test_cluster.py",
    "jobs/test_isolation.py",
    "jobs/test_full_disk.py",
    "fusion/test_scan_verdict.py",
    "fusion/test_merging.py",
    "fusion/test_meshing.py",
    "fusion/test_brightness.py",
    "fusion/test_smoothing.py",
    "fusion/test_support.py",
    "mesh/test_versions.py",
    "boards/test_detection.py",
    "calibration/test_joint_refinement.py",
    "calibration/test_light_sheets_fitted.py",
    "registration/test_faults.py",
    "registration/test_advice.py",
    "registration/test_halves.py",
    "stripes/test_code_sequences.py",
    "simulation/test_simulated_captures.py",
)
