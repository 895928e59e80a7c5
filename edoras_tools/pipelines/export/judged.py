"""Results of the doctor as topics: its verdicts, and the messages that did not arrive."""

from __future__ import annotations

from json import dumps
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.diagnosis.examination import Examination
from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor.doctor import examine, list_missing
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.ros.cdr.columns import MessageColumns, Ragged, TopicBlock

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.wire.arrays.order import Mask

VERDICTS_TOPIC: Final = "/edoras/verdicts"
LOST_TOPIC: Final = "/edoras/lost"
_TEXT, _COUNT, _TEXTS = "text", "count", "texts"
_FIELDS: Final = {
    VERDICTS_TOPIC: {
        "rule": _TEXT,
        "severity": _TEXT,
        "reason": _TEXT,
        "link": _TEXT,
        "msg_id": _TEXT,
        "topic": _TEXT,
        "hop": _TEXT,
        "lost": _COUNT,
        "of": _COUNT,
        "estimated": _COUNT,
        "end_ns": _COUNT,
        "evidence": _TEXTS,
        "remedy": _TEXT,
        "confidence": _TEXT,
    },
    LOST_TOPIC: {
        "link": _TEXT,
        "msg_id": _TEXT,
        "topic": _TEXT,
        "count": _COUNT,
        "until_ns": _COUNT,
        "number": _COUNT,
        "first": _COUNT,
        "one_of": _COUNT,
        "what": _TEXT,
        "message": _TEXT,
    },
}
"""Columns of each topic, named as in ``doctor --json`` and ``doctor --list-lost json``; a message is JSON."""
_TIME: Final = {VERDICTS_TOPIC: "start_ns", LOST_TOPIC: "time_ns"}
JUDGED: Final = frozenset(_FIELDS)
"""Topics that need an examination of the whole capture; made only if requested by name."""


def judged_blocks(
    topics: Collection[str],
    paths: Sequence[Path],
    settings: Settings,
    scope: Scope,
    progress: Progress | None = None,
) -> Iterator[TopicBlock]:
    """Examine captures, and yield the requested results.

    Args:
        topics: topics of ``JUDGED``.
        paths: the captures; they are read again.
        settings: missions, types and options.
        scope: part that is examined, and part that is shown.
        progress: shows the progress.
    """

    def opened() -> Any:
        return open_files(paths) if len(paths) == 1 else open_aligned(paths, settings, progress)[0]

    source = opened()
    bench = settings.workbench(source.info, paths)
    examination = Examination(bench.columns.context)
    examination.listing = LOST_TOPIC in topics
    diagnosis = examine(source, bench, scope=scope, progress=progress, examination=examination).diagnosis
    if VERDICTS_TOPIC in topics:
        yield judged_block(VERDICTS_TOPIC, [item.as_json() for item in diagnosis.verdicts])
    if examination.listing:
        result = list_missing(diagnosis, opened(), bench, progress)
        yield judged_block(LOST_TOPIC, [item.as_json() for item in result])


def judged_block(topic: str, rows: Sequence[Mapping[str, Any]] = ()) -> TopicBlock:
    """Return rows of JSON as a block; the time of a row is its start."""
    fields: dict[str, NDArray[Any] | Ragged] = {}
    present: dict[str, Mask] = {}
    for name, kind in _FIELDS[topic].items():
        values = [row[name] for row in rows]
        fields[name] = _MAKE[kind](values)
        if kind != _TEXTS:
            present[name] = np.array([value is not None for value in values], bool)
    time_ns = np.array([row[_TIME[topic]] for row in rows], np.int64)
    return TopicBlock(topic, time_ns, MessageColumns("", np.ones(len(rows), bool), fields), present=present)


def _texts(values: Sequence[Any]) -> NDArray[Any]:
    texts = [value if isinstance(value, str) else dumps(value, ensure_ascii=False) for value in values]
    return np.array(
        ["" if value is None else text for value, text in zip(values, texts, strict=True)], object
    )


def _lists(values: Sequence[Sequence[str]]) -> Ragged:
    offsets = np.cumsum([0, *map(len, values)])
    return Ragged(np.array([text for texts in values for text in texts], object), offsets)


_MAKE: Final[Mapping[str, Callable[[Sequence[Any]], NDArray[Any] | Ragged]]] = {
    _TEXT: _texts,
    _COUNT: lambda values: np.array([value or 0 for value in values], np.int64),
    _TEXTS: _lists,
}
