"""A process of jobs: `python -m bodyscan.jobs FOLDER`, or `--resident CALIBRATION`; started by a
batch or by `watch`, not by hand."""

import sys

if sys.argv[1] == "--resident":
    from bodyscan.jobs.resident_worker import main
else:
    from bodyscan.jobs.worker import main

sys.exit(main())
