"""The ring of cameras with exact truth is shared with the tests of registration."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "registration"))
