"""What a person looks at: one HTML file about a scan, a calibration or an acceptance test.

page holds what a report is made of, and result_page finds what a folder holds. scan_page,
calibration_page (with calibration_charts) and acceptance_page make their reports. pictures shades
bodies; charts uses Matplotlib; model packs what can be rotated.
measurement_table: measurements on screen, as JSON and CSV; measures_section: drawn on the body.
"""
