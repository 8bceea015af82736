"""OpenCV's predefined marker dictionaries by name, so that a rig file is checked without OpenCV."""

from __future__ import annotations

MARKERS_IN = {
    **{
        f"DICT_{bits}X{bits}_{count}": count
        for bits in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
    "DICT_ARUCO_MIP_36h12": 250,
}
"""How many markers each dictionary holds."""


def family(dictionary: str) -> str:
    """Dictionaries of one family share their first markers: DICT_4X4_50 begins DICT_4X4_1000."""
    head, _, count = dictionary.rpartition("_")
    return head if count.isdigit() else dictionary
