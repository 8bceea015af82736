"""The version of this software, as recorded in every file it writes."""

__version__ = "0.2.0"
