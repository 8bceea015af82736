"""What a person looks at: one HTML file about a scan, a calibration or an acceptance test.

page holds what a report is made of, and result_page finds what a folder holds. scan_page (with
comparison_section), calibration_page (with calibration_verdict and calibration_charts) and
acceptance_page make their reports. Pictures are drawn by pictures and sigma_map on a canvas, charts
as SVG; rotatable models are packed by model, from body_model and rig_model. measurements: a table
on screen.
"""
