"""The version of this software, as every file it writes says."""

__version__ = "0.1.0"
