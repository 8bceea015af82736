"""A process of jobs: `python -m bodyscan.jobs FOLDER`, or `--resident CALIBRATION`; a batch or `watch`
starts it, nobody needs to type it."""

import sys

if sys.argv[1] == "--resident":
    from bodyscan.jobs.resident_worker import main
else:
    from bodyscan.jobs.worker import main

sys.exit(main())
