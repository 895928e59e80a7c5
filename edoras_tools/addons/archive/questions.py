"""What an index answers: lists of captures and losses, the contents of a report, and a Parquet dataset.

The SQL of the queries is in ``queries.sql``, where the line ``-- NAME`` stands above each.
"""

from __future__ import annotations

import errno
import os
import shutil
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.addons.archive.index import TABLES, Index
from edoras_tools.addons.archive.page import BINS, MOST_COLUMNS, ArchiveTrends, bin_ns
from edoras_tools.errors import CaptureError, ConfigError, os_errors
from edoras_tools.io.outputs import check_folder, check_links, lock_older, name_that_fits
from edoras_tools.pipelines.selection import fits_topic

if TYPE_CHECKING:
    from collections.abc import Mapping


_FILE: Final = Path(__file__).with_name("queries.sql")
_QUERIES: Final = dict(part.split("\n", 1) for part in _FILE.read_text(encoding="utf-8").split("\n-- ")[1:])
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


_LONGEST: Final = 80
"""Longest topic in a folder's name, bytes: each takes up to three of 255; a longer one ends in its hash."""
_DATE: Final = "coalesce(strftime(c.began, '%Y-%m-%d'), 'unknown')"


def export_dataset(index: Index, folder: Path, *, force: bool) -> dict[str, int]:
    """Write every table of an index; afterwards a folder is complete, or absent.

    It is written in another folder beside it. Remains of a killed export there are removed, and an export
    that was about to be replaced then gets its name again.

    Args:
        folder: target; new, or empty.
        force: whether to replace an earlier export.

    Returns:
        Rows by table.

    Raises:
        ConfigError: the folder is not empty.
        CaptureError: the folder cannot be written.
    """
    check_folder(folder)
    beside = folder.with_name(name_that_fits(f".{folder.name}", ".part"))
    new, old = beside / "new", beside / "old"
    with os_errors(f"{folder}: cannot be written"):
        check_links(folder)
        folder.parent.mkdir(parents=True, exist_ok=True)
        check_links(beside)
        beside.mkdir(mode=0o700, exist_ok=True)
        if beside.stat().st_uid != os.geteuid():
            raise OSError(errno.EPERM, f"{beside} is another user's; name another output")
        lock = lock_older(beside)
    try:
        with os_errors(f"{folder}: cannot be written"):
            _put_back(old, folder)
            shutil.rmtree(new, ignore_errors=True)  # both are remains of a killed export
            shutil.rmtree(old, ignore_errors=True)
            _check_earlier(folder, force=force)
            new.mkdir()
            written = {name: _write(index, name, new / name) for name in TABLES}
            if folder.exists():
                folder.rename(old)
            new.rename(folder)
    finally:
        _put_back(old, folder)
        shutil.rmtree(beside, ignore_errors=True)
        if lock >= 0:
            os.close(lock)
    return written


def _put_back(old: Path, folder: Path) -> None:
    """Give an earlier export its name again, unless a new one has it."""
    if old.exists() and not folder.exists():
        old.rename(folder)


def _check_earlier(folder: Path, *, force: bool) -> None:
    if not folder.exists():
        return
    existing = {item.name for item in folder.iterdir()} if folder.is_dir() else {""}
    if existing and not force:
        raise ConfigError(f"{folder} exists; name another folder, or replace it with --force")
    if foreign := sorted(existing - {*TABLES}):
        subject = f"{foreign[0]} in it is" if foreign[0] else "it is"
        raise ConfigError(f"{folder}: {subject} of no earlier export; name another folder")


def _write(index: Index, name: str, folder: Path) -> int:
    """Write a table; a message without a topic is in the folder of its packet's name, else of its MsgId."""
    columns = TABLES[name].names
    keys: dict[str, Any] = {"date": _DATE}
    if "link" in columns:
        keys["link"] = "coalesce(t.link, 'none')"
    if "topic" in columns:
        names = [f"t.{item}" for item in ("topic", "name", "msg_id") if item in columns]
        topic = f"coalesce({', '.join(names)}, 'none')"
        keys["topic"] = f"if(strlen({topic}) > {_LONGEST}, {topic}[:16] || '~' || md5({topic}), {topic})"
    data_columns = ", ".join(f't."{item}"' for item in columns if item not in keys)
    key_columns = ", ".join(f"{value} AS {key}" for key, value in keys.items())
    more = ', t.topic AS "configured_topic"' if "topic" in keys else ""
    source = f"SELECT {data_columns}{more}, {key_columns} FROM {name} t JOIN captures c USING (capture)"
    if name == "captures":
        source = f"SELECT {data_columns.replace('t.', 'c.')}, {_DATE} AS date FROM captures c"
    ((count,),) = index.ask(f"SELECT count(*) FROM {name}")
    if count:
        place = str(folder).replace("'", "''")
        index.run(
            f"COPY ({source} ORDER BY {', '.join(keys)}, capture) TO '{place}' "
            f"(FORMAT parquet, COMPRESSION zstd, PARTITION_BY ({', '.join(keys)}))"
        )
    return int(count)
