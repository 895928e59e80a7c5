"""Questions that are often asked of an index."""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.pipelines.names import fits_topic

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.pipelines.archive.index import Index

_LISTED: Final = """
SELECT capture, state, error, gone, kind, size, sha256, datagrams, start_ns, end_ns, seconds, lost,
       superseded, unaccounted, capture_drops, worst
FROM captures
WHERE (? IS NULL OR end_ns >= ?) AND (? IS NULL OR start_ns < ?)
ORDER BY start_ns NULLS LAST, capture
"""
_LOST: Final = """
SELECT o.capture, start_ns, o.topic, o.name, o.link, o.msg_id, o.sent, o.lost, o.unaccounted, causes
FROM outcomes o
JOIN captures c ON c.capture = o.capture
LEFT JOIN (
    SELECT capture, link, msg_id, topic, list(cause ORDER BY cause) AS causes
    FROM (SELECT DISTINCT capture, link, msg_id, topic, cause FROM losses)
    GROUP BY ALL
) l
  ON l.capture = o.capture AND l.link IS NOT DISTINCT FROM o.link
  AND l.msg_id IS NOT DISTINCT FROM o.msg_id AND l.topic IS NOT DISTINCT FROM o.topic
WHERE o.lost + o.unaccounted > 0
  AND (? IS NULL OR c.end_ns >= ?) AND (? IS NULL OR c.start_ns < ?)
ORDER BY c.start_ns, o.capture, o.lost DESC, o.link, o.msg_id
"""


@dataclass(frozen=True, slots=True)
class ArchiveSpan:
    """A span of time; captures that overlap it are meant.

    Attributes:
        since_ns: ns since 1970 UTC; None for no limit.
        until_ns: ns since 1970 UTC, not included; None for no limit.
    """

    since_ns: int | None = None
    until_ns: int | None = None

    @property
    def values(self) -> list[int | None]:
        """The values of a query's four places."""
        return [self.since_ns, self.since_ns, self.until_ns, self.until_ns]


def list_captures(index: Index, span: ArchiveSpan) -> list[dict[str, Any]]:
    """Return the captures of a span of time, the oldest first; with a span, only those with datagrams."""
    return index.rows(_LISTED, span.values)


def list_losses(
    index: Index, span: ArchiveSpan, topics: tuple[str, ...] = (), *, over: float = 0.0
) -> list[dict[str, Any]]:
    """Return what was lost or is unaccounted for, by capture and route, the oldest capture first.

    Args:
        topics: patterns of topics, names or MsgIds; all if empty.
        over: only where more than this share of what was sent is missing.
    """
    found = [row for row in index.rows(_LOST, span.values) if not topics or _fits(row, topics)]
    for row in found:
        missing = row["lost"] + row["unaccounted"]
        row["share"] = missing / row["sent"] if row["sent"] else None
        row["causes"] = row["causes"] or []
    return [row for row in found if row["share"] is None or row["share"] > over]


def _fits(row: Mapping[str, Any], patterns: tuple[str, ...]) -> bool:
    names = [str(row[name]).upper() for name in ("name", "msg_id") if row[name]]
    return any(
        (row["topic"] and fits_topic(row["topic"], pattern))
        or any(fnmatchcase(name, pattern.upper()) for name in names)
        for pattern in patterns
    )
