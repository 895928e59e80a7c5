"""Captures in tests: their datagrams one by one, the error at their end, what was counted at the robot."""

from __future__ import annotations

from contextlib import closing

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file

ROBOT_GOT = {
    "a_rover": (508, 600),
    "b_arm_single": (120, 120),
    "c4_cmd_rate": (1287, 3080),
    "n1_to_remove_all": (210, 210),
    "n3_cfs_restart": (207, 245),
    "n5_app_restarts": (174, 310),
    "p6b_extended_header": (277, 300),
}
"""Of the commands on 0x1827 of captures in tests/captures: how many reached the robot of how many sent."""


def read(path):
    """Return all datagrams of a file, and the message of the error at its end."""
    with closing(open_file(path)) as source:
        rows = []
        try:
            rows.extend(row for batch in source.batches() for row in batch)
        except CaptureError as error:
            return rows, str(error)
    return rows, ""
