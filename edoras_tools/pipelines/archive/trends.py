"""What a report says of an index: runs over time, trends of routes, and the worst of both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.io.outputs import write_bytes
from edoras_tools.render.archive.page import BINS, ArchiveTrends, archive_page, bin_ns

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.pipelines.archive.index import Index
    from edoras_tools.pipelines.archive.questions import ArchiveSpan
    from edoras_tools.render.doctor.report import Made

_MOST_ROUTES: Final = 12
_MOST_DELAYED: Final = 6
_MOST_WORST: Final = 20
_ROUTE: Final = "coalesce({0}.topic, {0}.name, {0}.msg_id, 'of unknown MsgId')"
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
    """Ask an index for all that a report shows.

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
    often = [row for row in routes if row["captures"] > 1]  # one run is no trend
    bins = [totals["start_ns"], bin_ns(totals)]
    return ArchiveTrends(
        str(index.path),
        totals,
        index.rows(_RUNS),
        routes,
        [(row, index.rows(_TREND, [*bins, row["route"], row["link"]])) for row in often[:_MOST_ROUTES]],
        [(row, index.rows(_DELAYS, [row["route"], row["link"], row["part"]])) for row in delayed],
        index.rows(_RULES),
        [error for (error,) in bad],
    )


def write_archive_report(index: Index, span: ArchiveSpan, path: Path, made: Made) -> int:
    """Write the page; return its size in bytes.

    Raises:
        CaptureError: there is nothing to report, or the file cannot be written.
    """
    data = archive_page(trends_of(index, span), made).encode("utf-8", "replace")
    write_bytes(path, data)
    return len(data)
