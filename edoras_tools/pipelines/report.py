"""A diagnosis into one HTML file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.errors import CaptureError
from edoras_tools.render.report import page

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.diagnosis.examination import Diagnosis


def write(diagnosis: Diagnosis, name: str, path: Path) -> int:
    """Write the page; return its size in bytes.

    Raises:
        CaptureError: the file cannot be written.
    """
    data = page(diagnosis, name).encode("utf-8", "replace")
    try:
        path.write_bytes(data)
    except OSError as error:
        raise CaptureError(f"{path}: cannot be written: {error.strerror or error}") from error
    return len(data)
