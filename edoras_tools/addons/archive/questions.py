"""Queries of an index: lists of captures and losses, and the contents of a report.

Their SQL is in ``queries.sql``, where the line ``-- name: NAME`` stands above each.
"""

from __future__ import annotations

from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.archive.page import BINS, MOST_COLUMNS, ArchiveTrends, bin_ns
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.selection import fits_topic

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.addons.archive.index import Index


_FILE: Final = Path(__file__).with_name("queries.sql")
_QUERIES: Final = dict(
    part.split("\n", 1) for part in _FILE.read_text(encoding="utf-8").split("\n-- name: ")[1:]
)
"""Queries by name."""


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
    return index.rows(_QUERIES["listed"], span.values)


def list_losses(
    index: Index, span: ArchiveSpan, topics: tuple[str, ...] = (), *, over: float = 0.0
) -> list[dict[str, Any]]:
    """Return lost and unaccounted messages, by capture and route, the oldest capture first.

    Args:
        topics: patterns of topics, names or MsgIds; empty for all.
        over: share of the sent messages; only rows with more missing messages are returned.
    """
    losses = [row for row in index.rows(_QUERIES["lost"], span.values) if not topics or _fits(row, topics)]
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
    captures = {
        row["capture"]
        for row in index.rows(_QUERIES["sent"], span.values)
        if not topics or _fits(row, topics)
    }
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


def trends_of(index: Index, span: ArchiveSpan) -> ArchiveTrends:
    """Query an index for all contents of a report.

    Raises:
        CaptureError: no capture with datagrams is in the span.
    """
    limits = [f"end_ns >= {span.since_ns}"] if span.since_ns is not None else []
    limits += [f"start_ns < {span.until_ns}"] if span.until_ns is not None else []
    index.run(_QUERIES["route"])
    index.run(_QUERIES["chosen"].format(" AND ".join(limits) or "true"))

    def rows(name: str, *values: object) -> list[dict[str, Any]]:
        return index.rows(_QUERIES[name], values)

    (totals,) = rows("totals")
    if not totals["captures"]:
        raise CaptureError(f"{index.path}: has no capture with datagrams in this time; nothing to report")
    bad = index.ask("SELECT error FROM captures WHERE error IS NOT NULL ORDER BY capture")
    routes = rows("routes")
    often = [row for row in routes if row["captures"] > 1]  # a single run is no trend
    bins = totals["start_ns"], bin_ns(totals), BINS - 1
    return ArchiveTrends(
        str(index.path),
        totals,
        rows("runs"),
        routes,
        rows("shares", MOST_COLUMNS),
        [(row, rows("trend", *bins, row["route"], row["link"])) for row in often[:_MOST_ROUTES]],
        [(row, rows("delays", row["route"], row["link"], row["part"])) for row in rows("delayed")],
        rows("rules"),
        [error for (error,) in bad],
    )
