"""The job's process: `python -m bodyscan.jobs FOLDER`; a batch starts it, nobody needs to type it."""

import sys

from bodyscan.jobs.worker import main

sys.exit(main())
