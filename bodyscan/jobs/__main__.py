"""A process of jobs: `python -m bodyscan.jobs FOLDER`, or `--resident CALIBRATION`; started by a
batch or by `watch`, not by hand."""

import sys

from bodyscan.jobs.worker import main, stay

sys.exit(stay() if sys.argv[1] == "--resident" else main())
