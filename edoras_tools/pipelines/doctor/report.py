"""Writes a diagnosis to one HTML file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.io.outputs import write_bytes
from edoras_tools.render.doctor.report import page

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.render.doctor.report import Made


def write_report(diagnosis: Diagnosis, name: str, path: Path, made: Made) -> int:
    """Write the page; return its size in bytes.

    Raises:
        CaptureError: the file cannot be written.
    """
    data = page(diagnosis, name, made).encode("utf-8", "replace")
    write_bytes(path, data, folders=True)
    return len(data)
