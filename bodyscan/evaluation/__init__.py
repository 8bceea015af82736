"""Results against what is known: surfaces and bodies of simulation, spheres and planes of artefacts.

surface (signed distances, coverage), body (girths, sway left in), comparison (scan against scan);
planes, spheres and sphere_search (one range image on artefacts); artefacts, acceptance_file and
acceptance_readings (the acceptance test).
"""
