"""Many recordings, each read separately, as one mapping of tables: ``edoras_tools.read("runs/")``."""

from __future__ import annotations

import dataclasses
from collections import Counter
from contextlib import suppress
from functools import cached_property, partial
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING

from msgspec.structs import replace

from edoras_tools.errors import CaptureError, RouteError
from edoras_tools.io.formats.rosbag2.reader import METADATA
from edoras_tools.io.formats.table import FILE_SUFFIXES
from edoras_tools.pipelines.export.reading import NoTopicError, RecordingTables, TopicTable
from edoras_tools.pipelines.export.sources import TopicSource, recording_names
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.io.formats.columns import TableColumn

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
