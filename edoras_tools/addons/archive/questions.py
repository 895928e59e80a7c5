"""Queries of an index: lists of captures and losses, and the contents of a report."""

from __future__ import annotations

from fnmatch import fnmatchcase
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.archive.page import BINS, MOST_COLUMNS, ArchiveTrends, bin_ns
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.selection import fits_topic

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.addons.archive.index import Index


_LISTED: Final = """
SELECT capture, state, error, gone, kind, size, sha256, datagrams, start_ns, end_ns, seconds, lost,
       superseded, unaccounted, capture_drops, worst
FROM captures
WHERE (? IS NULL OR end_ns >= ?) AND (? IS NULL OR start_ns < ?)
ORDER BY start_ns NULLS LAST, capture
"""
_LOST: Final = """
SELECT o.capture, start_ns, o.topic, o.name, o.link, o.msg_id, o.spacecraft, o.sent, o.lost, o.unaccounted,
       causes
FROM outcomes o
JOIN captures c ON c.capture = o.capture
LEFT JOIN (
    SELECT capture, link, msg_id, topic, spacecraft, list(cause ORDER BY cause) AS causes
    FROM (SELECT DISTINCT capture, link, msg_id, topic, spacecraft, cause FROM losses)
    GROUP BY ALL
) l
  ON l.capture = o.capture AND l.link IS NOT DISTINCT FROM o.link
  AND l.msg_id IS NOT DISTINCT FROM o.msg_id AND l.topic IS NOT DISTINCT FROM o.topic
  AND l.spacecraft IS NOT DISTINCT FROM o.spacecraft
WHERE o.lost + o.unaccounted > 0
  AND (? IS NULL OR c.end_ns >= ?) AND (? IS NULL OR c.start_ns < ?)
ORDER BY c.start_ns, o.capture, o.lost DESC, o.link, o.msg_id
"""
_SENT: Final = """
SELECT DISTINCT capture, o.topic, o.name, o.msg_id
FROM outcomes o JOIN captures c USING (capture)
WHERE o.sent > 0 AND (? IS NULL OR c.end_ns >= ?) AND (? IS NULL OR c.start_ns < ?)
"""


class ArchiveSpan(msgspec.Struct, frozen=True):
    """A span of time; it selects captures that overlap it.

    Attributes:
        since_ns: ns since 1970 UTC; None for no limit.
        until_ns: ns since 1970 UTC, not included; None for no limit.
    """

    since_ns: int | None = None
    until_ns: int | None = None

    @property
    def values(self) -> list[int | None]:
        """Values of the four parameters of a query."""
        return [self.since_ns, self.since_ns, self.until_ns, self.until_ns]


def list_captures(index: Index, span: ArchiveSpan) -> list[dict[str, Any]]:
    """Return the captures of a span of time, the oldest first; with a span, only those with datagrams."""
    return index.rows(_LISTED, span.values)


def list_losses(
    index: Index, span: ArchiveSpan, topics: tuple[str, ...] = (), *, over: float = 0.0
) -> list[dict[str, Any]]:
    """Return lost and unaccounted messages, by capture and route, the oldest capture first.

    Args:
        topics: patterns of topics, names or MsgIds; empty for all.
        over: share of the sent messages; only rows with more missing messages are returned.
    """
    losses = [row for row in index.rows(_LOST, span.values) if not topics or _fits(row, topics)]
    for row in losses:
        missing = row["lost"] + row["unaccounted"]
        row["share"] = missing / row["sent"] if row["sent"] else None
        row["causes"] = row["causes"] or []
    return [row for row in losses if row["share"] is None or row["share"] > over]


def count_examined(index: Index, span: ArchiveSpan, topics: tuple[str, ...] = ()) -> int:
    """Return the number of captures of a span of time with messages, of these topics if any are named.

    Raises:
        CaptureError: there is no such capture.
    """
    captures = {row["capture"] for row in index.rows(_SENT, span.values) if not topics or _fits(row, topics)}
    if not captures:
        of = " of these topics" if topics else ""
        raise CaptureError(
            f"{index.path}: has no capture of this time with messages{of}; "
            "'edoras archive list' shows the captures"
        )
    return len(captures)


def _fits(row: Mapping[str, Any], patterns: tuple[str, ...]) -> bool:
    names = [str(row[name]).upper() for name in ("name", "msg_id") if row[name]]
    return any(
        (row["topic"] and fits_topic(row["topic"], pattern))
        or any(fnmatchcase(name, pattern.upper()) for name in names)
        for pattern in patterns
    )


_MOST_ROUTES: Final = 12
_MOST_DELAYED: Final = 6
_MOST_WORST: Final = 20
_ROUTE: Final = (
    "coalesce({0}.topic, if({0}.spacecraft > 1, 'sc_' || {0}.spacecraft || ' ', '') "
    "|| coalesce({0}.name, {0}.msg_id), 'of unknown MsgId')"
)
_CHOSEN: Final = """
CREATE OR REPLACE TEMP VIEW chosen AS SELECT * FROM captures WHERE datagrams > 0 AND {}
"""
_TOTALS: Final = """
SELECT count(*) AS captures, sum(datagrams) AS datagrams, sum(seconds) AS seconds, min(start_ns) AS start_ns,
       max(end_ns) AS end_ns, coalesce(sum(lost), 0) AS lost, coalesce(sum(unaccounted), 0) AS unaccounted,
       count(*) FILTER (lost + unaccounted > 0) AS with_loss
FROM chosen
"""
_RUNS: Final = """
SELECT c.capture, c.start_ns, c.datagrams, c.worst, c.lost, c.unaccounted, coalesce(sum(o.sent), 0) AS sent
FROM chosen c LEFT JOIN outcomes o USING (capture)
GROUP BY ALL ORDER BY c.start_ns, c.capture
"""
_ROUTES: Final = f"""
SELECT {_ROUTE.format("o")} AS route, coalesce(o.link, '') AS link, count(DISTINCT o.capture) AS captures,
       count(DISTINCT o.capture) FILTER (o.lost + o.unaccounted > 0) AS with_loss,
       sum(o.sent) AS sent, sum(o.lost) AS lost, sum(o.unaccounted) AS unaccounted
FROM outcomes o JOIN chosen USING (capture)
GROUP BY 1, 2 HAVING sum(o.lost + o.unaccounted) > 0
ORDER BY sum(o.lost + o.unaccounted) DESC, route, link
LIMIT {_MOST_WORST}
"""
_SHARES: Final = f"""
WITH latest AS (
    SELECT capture, start_ns FROM chosen ORDER BY start_ns DESC, capture DESC LIMIT {MOST_COLUMNS}
)
SELECT capture, start_ns, {_ROUTE.format("o")} AS route, coalesce(o.link, '') AS link, sum(o.sent) AS sent,
       sum(o.lost + o.unaccounted) AS missing
FROM outcomes o JOIN latest USING (capture)
GROUP BY ALL HAVING sum(o.sent) > 0 ORDER BY start_ns, capture
"""
_TREND: Final = f"""
SELECT least((c.start_ns - ?) // ?, {BINS - 1})::INT AS bin, sum(o.sent) AS sent,
       sum(o.lost + o.unaccounted) AS missing
FROM outcomes o JOIN chosen c USING (capture)
WHERE {_ROUTE.format("o")} = ? AND coalesce(o.link, '') = ?
GROUP BY 1 ORDER BY 1
"""
_DELAYED: Final = f"""
SELECT {_ROUTE.format("l")} AS route, l.link, l.part, max(l.p99_ms) AS p99_ms, sum(l.count) AS timed,
       count(DISTINCT l.capture) AS captures
FROM latencies l JOIN chosen USING (capture)
GROUP BY 1, 2, 3 HAVING max(l.p99_ms) > 0
ORDER BY captures > 1 DESC, p99_ms DESC, route, link, part
LIMIT {_MOST_DELAYED}
"""
_DELAYS: Final = f"""
SELECT c.start_ns, max(l.p99_ms) AS p99_ms
FROM latencies l JOIN chosen c USING (capture)
WHERE {_ROUTE.format("l")} = ? AND l.link = ? AND l.part = ?
GROUP BY ALL ORDER BY 1
"""
_RULES: Final = """
SELECT severity, rule, count(DISTINCT capture) AS captures, count(*) AS verdicts, sum(v.lost) AS lost,
       arg_max(reason, coalesce(v.lost, 0)) AS example
FROM verdicts v JOIN chosen USING (capture)
WHERE severity IN ('error', 'warning')
GROUP BY 1, 2 ORDER BY severity, captures DESC, rule
"""


def trends_of(index: Index, span: ArchiveSpan) -> ArchiveTrends:
    """Query an index for all contents of a report.

    Raises:
        CaptureError: no capture with datagrams is in the span.
    """
    limits = [f"end_ns >= {span.since_ns}"] if span.since_ns is not None else []
    limits += [f"start_ns < {span.until_ns}"] if span.until_ns is not None else []
    index.run(_CHOSEN.format(" AND ".join(limits) or "true"))
    (totals,) = index.rows(_TOTALS)
    if not totals["captures"]:
        raise CaptureError(f"{index.path}: has no capture with datagrams in this time; nothing to report")
    bad = index.ask("SELECT error FROM captures WHERE error IS NOT NULL ORDER BY capture")
    routes, delayed = index.rows(_ROUTES), index.rows(_DELAYED)
    often = [row for row in routes if row["captures"] > 1]  # a single run is no trend
    bins = [totals["start_ns"], bin_ns(totals)]
    return ArchiveTrends(
        str(index.path),
        totals,
        index.rows(_RUNS),
        routes,
        index.rows(_SHARES),
        [(row, index.rows(_TREND, [*bins, row["route"], row["link"]])) for row in often[:_MOST_ROUTES]],
        [(row, index.rows(_DELAYS, [row["route"], row["link"], row["part"]])) for row in delayed],
        index.rows(_RULES),
        [error for (error,) in bad],
    )
