"""``edoras export --partition``: a folder for each topic, in it one for each recording, in Hive's form.

Also many recordings, each read separately, as one mapping of tables: ``edoras_tools.read("runs/")``.

Also cFE's performance log as a trace that Chrome and Perfetto show.
"""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from functools import cached_property, partial
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from msgspec.structs import replace

from edoras_tools.cli.export import print_written
from edoras_tools.cli.output import file_progress, tell
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, InterruptError, RouteError, os_errors
from edoras_tools.io.formats.cfe import CfeFile, marker_name, read_cfe_file
from edoras_tools.io.formats.rosbag2.reader import METADATA
from edoras_tools.io.formats.table import FILE_SUFFIXES
from edoras_tools.io.outputs import check_new, write_bytes
from edoras_tools.pipelines.export.reading import NoTopicError, RecordingTables, TopicTable
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.export.sources import TopicSource, open_topics, recording_names
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from edoras_tools.cli.options import PrintOptions
    from edoras_tools.io.formats.columns import TableColumn
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.workbench import Settings

_PACKED = ("", ".gz", ".zst")


def recordings_in(paths: Iterable[Path]) -> list[Path]:
    """Return the recordings that paths name: files, those in folders, and matches of patterns, each sorted.

    Raises:
        CaptureError: a folder holds none, or nothing matches a pattern.
    """
    files: list[Path] = []
    for path in paths:
        inside = [path]
        if path.is_dir() and not (path / METADATA).exists():
            inside = sorted(item for item in path.iterdir() if _is_recording(item))
        elif not path.exists() and any(sign in str(path) for sign in "*?["):
            inside = [Path(item) for item in sorted(glob(str(path), recursive=True))]  # noqa: PTH207  from any root
        if not inside:
            raise CaptureError(f"{path}: no capture or recording is there; name a folder that holds some")
        files += inside
    return files


def _is_recording(path: Path) -> bool:
    if path.is_dir():
        return (path / METADATA).exists()
    return any(path.name.endswith(f"{suffix}{packed}") for suffix in FILE_SUFFIXES for packed in _PACKED)


def read_recordings(tables: RecordingTables) -> RecordingTables:
    """Return the tables of the recordings that folders and patterns name, each read separately.

    Raises:
        CaptureError: there is none.
    """
    files = recordings_in(tables.paths)
    paths = zip(recording_names([*map(str, files)]), files, strict=True)
    each = [dataclasses.replace(tables, paths=(file,), recording=name) for name, file in paths]
    return ManyRecordings(files, tables.settings, tables.scope, tables.form, recordings=each)


@dataclasses.dataclass(frozen=True, repr=False)
class ManyRecordings(RecordingTables):
    """The topics of many recordings; one is open at a time, and each has its own mission.

    A table has the rows of the recordings one after the other; a recording without the topic has none.

    Attributes:
        recordings: tables of each recording.
    """

    recordings: Sequence[RecordingTables] = ()

    def __repr__(self) -> str:
        names = listed([item.recording for item in self.recordings], 3)
        return f"<{plural(len(self.recordings), 'recording')}: {names}; list() names their topics>"

    def __getitem__(self, topic: str) -> TopicTable:
        """Return the messages of a topic in all recordings.

        Raises:
            NoTopicError: no recording has the topic, or several topics match.
        """
        *others, last = self.recordings
        for item in others:
            with suppress(NoTopicError):
                return self._joined(item[topic])
        return self._joined(last[topic])

    @cached_property
    def topics(self) -> dict[str, int]:
        """Number of messages of each topic that has any, over all recordings."""
        return dict(sum((Counter(item.topics) for item in self.recordings), Counter[str]()))

    def _joined(self, first: TopicTable) -> TopicTable:
        """Return the table of a topic in all recordings, given the table in one of them."""
        table = replace(first, pieces=partial(self._every, first.topic, first.type))
        return self._tables.setdefault(first.topic, table)

    def _open(self) -> TopicSource:
        return self.recordings[0]._open()  # noqa: SLF001  what is wrong with all is wrong with this

    def _every(self, topic: str, kind: str) -> Iterator[Sequence[TableColumn]]:
        """Yield the pieces of a topic in every recording that has it.

        Raises:
            RouteError: two recordings have the topic with different types.
        """
        for item in self.recordings:
            with suppress(NoTopicError):
                if item[topic].type != kind:
                    types = f"{item[topic].type} in {item.recording} and {kind} in others"
                    raise RouteError(f"{topic} is {types}; read them separately")
                yield from item[topic].pieces()


class _Partition(ExportTarget, frozen=True):
    """The output of one recording.

    Attributes:
        recording: name of the recording.
    """

    recording: str = ""

    def place(self, topic: str) -> Path:
        """Return the file of a topic, ``TOPIC/recording=NAME/data.parquet``; create its folder."""
        folder = ExportTarget.place(self, topic).with_suffix("")
        folder /= f"recording={quote(self.recording, safe=' ')}"
        with os_errors(f"{folder}: cannot be created"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder / f"data{self.format.suffix}"


def export_by_recording(
    files: Sequence[Path],
    target: ExportTarget,
    settings: Settings,
    scope: Scope,
    printing: PrintOptions,
    **how: Any,
) -> None:
    """Export recordings, each separately and with its own mission, and print the result.

    Args:
        files: recordings, or folders of them.
        target: a folder.
        how: further arguments of ``export``.

    Raises:
        CaptureError: a table cannot be written, there is nothing to write, or, once all others are written,
            some recordings could not be read whole.
        ConfigError: the output is no folder or not empty, or a mission or a field has a mistake.
    """
    if not target.folder:
        raise ConfigError(f"{target.path}: --partition writes folders: name one that ends with /")
    paths = recordings_in(files)
    written: list[dict[str, Any]] = []
    warnings: Counter[str] = Counter()
    without: list[str] = []
    first: EdorasError | None = None
    left_out = failed = 0
    with file_progress(files, quiet=printing.quiet or printing.json) as progress:
        for place, (path, name) in enumerate(zip(paths, recording_names([*map(str, paths)]), strict=True)):
            progress.step("exporting", place, len(paths))
            own, source = _Partition(target.path, target.format, target.folder, target.force, name), None
            try:
                source = open_topics([path], settings, scope)
                report = export(source, own, **how).summary()
                written += [{**item, "recording": name} for item in report["files"]]
                failure: EdorasError | None = source.failure
            except (CaptureError, RouteError) as error:
                first, failure = first or error, error
                if source and not (source.failure or source.damage):
                    without.append(name)
                    failure = None
            if isinstance(failure, InterruptError):
                raise failure
            failed += failure is not None
            warnings.update([*(source.notes if source else ()), *([str(failure)] if failure else ())])
            left_out += source.left_out if source else 0
    if first and not written:
        raise first
    lines = [f"{line} ({count:,} recordings)" if count > 1 else line for line, count in warnings.items()]
    if without:
        lines.append(f"{plural(len(without), 'recording')} without a message of these: {listed(without, 3)}")
    summary = {"source": listed([*map(str, files)], 3), "left_out": left_out, "warnings": lines}
    print_written({**summary, "files": written if printing.json else by_topic(written)}, printing)
    tell(*lines)
    if failed:
        raise CaptureError(f"{failed:,} of {plural(len(paths), 'recording')} could not be read whole")


def by_topic(files: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry per topic: its folder, and the number of rows in all recordings."""
    topics: dict[str, dict[str, Any]] = {}
    for item in files:
        whole = {**item, "path": f"{Path(item['path']).parents[1]}/", "rows": 0}
        topics.setdefault(item["topic"], whole)["rows"] += item["rows"]
    return [*topics.values()]


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
