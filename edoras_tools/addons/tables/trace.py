"""cFE's performance log as a trace that Chrome and Perfetto show."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.cfe import CfeFile, marker_name, read_cfe_file
from edoras_tools.io.outputs import check_new, write_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path


_MICROSECOND = 1000.0


def export_trace(files: Sequence[Path], path: Path, *, force: bool) -> dict[str, Any] | None:
    """Write the Trace Event Format's JSON of a performance log.

    Args:
        files: the input.
        path: a ``.json`` file.
        force: replace an existing one.

    Returns:
        The shape of ``export --json``, with unpaired markers as ``left_out``; None if the input is not such a
        log.

    Raises:
        CaptureError: the log is damaged, or the trace cannot be written.
        ConfigError: the output exists, or the suffix is not ``.json``.
    """
    log = read_cfe_file(files[0]) if len(files) == 1 else None
    if log is None or log.markers is None:
        return None
    if path.suffix != ".json":
        raise ConfigError(f"{path}: a performance log is exported as a trace; use .json")
    check_new(path, files, force=force)
    events = [*_events(log)]
    write_bytes(path, json.dumps({"traceEvents": events, "displayTimeUnit": "ns"}).encode(), folders=True)
    spans = len(log.spans)
    file = {"path": str(path), "topic": log.kind, "type": "", "rows": spans}
    left_out = len(log.markers) - 2 * spans
    return {"source": str(log.path), "files": [file], "left_out": left_out, "warnings": []}


def _events(log: CfeFile) -> Iterator[dict[str, Any]]:
    """Yield the names of the markers, one row of the trace each, then a complete event for each span."""
    process = log.header["processor_id"]
    spans = log.spans.tolist()
    for number in sorted({marker for marker, _, _ in spans}):
        yield {
            "name": "thread_name",
            "ph": "M",
            "pid": process,
            "tid": number,
            "args": {"name": marker_name(number)},
        }
    for marker, begin_ns, length_ns in spans:
        times = {"ts": begin_ns / _MICROSECOND, "dur": length_ns / _MICROSECOND}
        yield {"name": marker_name(marker), "ph": "X", "pid": process, "tid": marker, **times}
