"""cFE's performance log as a trace that Chrome and Perfetto show."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.cfe.contents import CfeFile, marker_name, read_cfe_file
from edoras_tools.io.outputs import check_new, write_bytes

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

_MICROSECOND = 1000.0


class TraceReport(msgspec.Struct, frozen=True):
    """The result of writing a trace.

    Attributes:
        log: the performance log.
        path: the trace.
        spans: number of periods from an entry to its exit.
    """

    log: CfeFile
    path: Path
    spans: int

    def summary(self) -> dict[str, Any]:
        """Return the report in the shape of ``export --json``; unpaired markers are ``left_out``."""
        assert self.log.markers is not None
        file = {"path": str(self.path), "topic": self.log.kind, "type": "", "rows": self.spans}
        left_out = len(self.log.markers) - 2 * self.spans
        return {"source": str(self.log.path), "files": [file], "left_out": left_out, "warnings": []}


def export_trace(files: Sequence[Path], path: Path, *, force: bool) -> TraceReport | None:
    """Write the Trace Event Format's JSON of a performance log; return None if the input is something else.

    Args:
        files: the input.
        path: a ``.json`` file.
        force: replace an existing one.

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
    return TraceReport(log, path, len(log.spans))


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
