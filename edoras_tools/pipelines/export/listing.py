"""What is in a recording of topics: how many messages of each, how often, how large."""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from edoras_tools.pipelines.export.sources import BagTopics
from edoras_tools.pipelines.export.tables import chosen_topics
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.rosbag2.reader import RecordedBlock
    from edoras_tools.pipelines.export.sources import TopicSource


@dataclass(slots=True)
class _Account:
    """The messages of a topic, in the order of the recording; times in ns since 1970, sizes in bytes."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    size: int = 0
    least: int = 0
    most: int = 0
    steps: float = 0.0
    squares: float = 0.0

    def add(self, found: RecordedBlock) -> None:
        times = found.time_ns
        before = [self.last_ns] if self.count else []
        seconds = np.diff(np.concatenate([np.array(before, np.int64), times])) / SECOND
        self.steps += float(seconds.sum())
        self.squares += float((seconds**2).sum())
        self.first_ns = min(self.first_ns, int(times.min())) if self.count else int(times.min())
        self.last_ns = int(times[-1])
        least = int(found.length.min())
        self.least = min(self.least, least) if self.count else least
        self.most = max(self.most, int(found.length.max()))
        self.size += int(found.length.sum())
        self.count += len(times)

    def row(self, topic: str, kind: str) -> dict[str, Any]:
        between = max(self.count - 1, 1)
        mean = self.steps / between
        return {
            "topic": topic,
            "type": kind,
            "name": None,
            "link": None,
            "processor_id": None,
            "msg_id": None,
            "count": self.count,
            "rate_hz": round(1 / mean, 3) if mean > 0 else 0.0,
            "jitter_ms": round(sqrt(max(self.squares / between - mean**2, 0.0)) * 1000, 3),
            "gaps": None,
            "duplicates": None,
            "reordered": None,
            "bytes": self.size,
            "bytes_min": self.least,
            "bytes_max": self.most,
            "findings": {},
        }


def list_topics(source: TopicSource, patterns: Sequence[str] = ()) -> dict[str, Any]:
    """Read a recording of topics to its end; return what is in it, in the form of ``info --json``.

    Args:
        source: the recording; ``failure`` says why it ended early.
        patterns: which topics; all by default.

    Raises:
        RouteError: a pattern fits no topic.
        CaptureError: no message was found.
    """
    assert isinstance(source, BagTopics), "a recording with datagrams has routes"
    wanted = chosen_topics(source, patterns, source.topics)
    accounts = {topic: _Account() for topic in wanted}
    begin_ns = end_ns = -1
    for found in source.recorded(wanted):
        if len(found.time_ns):
            accounts[found.topic].add(found)
            first, last = int(found.time_ns.min()), int(found.time_ns.max())
            begin_ns, end_ns = first if begin_ns < 0 else min(begin_ns, first), max(end_ns, last)
    counted = {topic: item for topic, item in accounts.items() if item.count}
    source.check_found(counted, wanted)
    return {
        "source": source.name,
        "kind": "topics",
        "datagrams": 0,
        "messages": sum(item.count for item in counted.values()),
        "skipped": 0,
        "start_ns": begin_ns,
        "end_ns": end_ns,
        "capture_drops": None,
        "outages": [],
        "routes": [item.row(topic, source.topics[topic]) for topic, item in accounts.items()],
        "findings": {},
        "warnings": source.notes,
    }
