"""Compare results with known values: simulated bodies, spheres and planes of artefacts.

surface (signed distances, coverage), body (girths, remaining sway), comparison (scan against scan);
planes, spheres and sphere_search (one range image of artefacts); artefacts, acceptance_file and
acceptance_readings (the acceptance test).
"""
