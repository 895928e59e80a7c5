"""Reading a capture in a test: its datagrams one by one, and the error at its end."""

from __future__ import annotations

from contextlib import closing

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.open import open_file


def read(path):
    """Return all datagrams of a file, and the message of the error at its end."""
    with closing(open_file(path)) as source:
        rows = []
        try:
            rows.extend(row for batch in source.batches() for row in batch)
        except CaptureError as error:
            return rows, str(error)
    return rows, ""
