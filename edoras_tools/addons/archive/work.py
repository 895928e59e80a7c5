"""The work of a worker: reads a group of captures, each once, and returns their rows as Arrow tables.

A worker is any process that can import this module, on this or another machine. It keeps no state between two
groups, so another worker can repeat a group with the same result.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime, timedelta
from hashlib import sha256
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools import __version__
from edoras_tools.addons.archive.index import TABLES, IndexTable
from edoras_tools.addons.archive.places import ListedFile, at_hand, cause_of, is_remote, listed_now, reason_of
from edoras_tools.diagnosis.balance import sent
from edoras_tools.diagnosis.evidence.payloads import EventRecord, events_in
from edoras_tools.diagnosis.ledger import CAPTURE, Row
from edoras_tools.errors import CaptureError, EdorasError, OnFailure
from edoras_tools.io.formats.open import open_file
from edoras_tools.older import UTC
from edoras_tools.pipelines.capture.info import Counting
from edoras_tools.pipelines.doctor import Findings, examine
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.pipelines.reading import ReadLoop
    from edoras_tools.pipelines.workbench import Settings, Workbench

    IndexRows = dict[str, list[dict[str, Any]]]
    """Name of a table to its rows."""

_MOST_EVENTS: Final = 1_000_000
"""Maximum number of events of one capture; a warning reports the rest."""
_HASHED_BYTES: Final = 1 << 20
_TRIES: Final = 3
"""Number of consecutive captures that cannot be fetched, after which the rest of the group is skipped: each
may take many seconds, and the next update tries all of them again."""
READ_WHOLE, READ_IN_PART, NOT_READ, CHANGING = "whole", "cut", "unreadable", "changing"
"""States of a capture."""
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_ROUTE: Final = ("link", "msg_id", "topic", "name", "spacecraft")
_SENDERS: Final = (*_ROUTE, "sender", "receiver", "instance")
_GONE: Final = ("superseded", "waiting", "not_captured", "unaccounted")


class Task(msgspec.Struct, frozen=True):
    """A group of captures to read.

    Attributes:
        captures: URL of each capture, with its hash in the index for these settings; empty for none.
        settings: missions and options for reading; the worker needs the same files.
        fingerprint: hash of the settings on the machine that submits the work.
    """

    captures: tuple[tuple[str, str], ...]
    settings: Settings
    fingerprint: str


class Done(msgspec.Struct, frozen=True):
    """The result of a group.

    Attributes:
        rows: name of a table to its rows, a ``pyarrow.Table``; tables without rows are absent.
        same: captures with unchanged contents, but a new version.
        misfit: reason why the worker can read nothing; empty if it can.
    """

    rows: dict[str, Any]
    same: tuple[ListedFile, ...] = ()
    misfit: str = ""


def fingerprint(settings: Settings, bench: Workbench | None = None) -> str:
    """Return a hash of all settings that affect reading: options, and the contents of the named files.

    Args:
        bench: workbench of the settings, if it exists already.

    Raises:
        EdorasError: a file cannot be read.
    """
    bench = bench or settings.workbench()  # a mistake in a mission is reported once, not for each capture
    parts: list[Any] = [settings.distro, sorted(settings.options.described().items())]
    parts += [(name, sha256(data).hexdigest()) for name, data in sorted(bench.mission.files.items())]
    for folder in settings.msg_paths:
        files = sorted(item for item in folder.rglob("*") if item.suffix in {".msg", ".idl"})
        parts += [(str(item.relative_to(folder)), _hash(item)) for item in files]
    return sha256(json.dumps(parts).encode()).hexdigest()


def examine_group(task: Task) -> Done:
    """Read a group of captures; an error of one is stored in its row."""
    try:
        bench = task.settings.workbench()
        settings_print = fingerprint(task.settings, bench)
    except (EdorasError, OSError) as error:
        return Done({}, misfit=f"a worker cannot read the mission: {error}")
    if settings_print != task.fingerprint:
        misfit = "a worker sees other mission files, or another edoras-tools, than this machine"
        return Done({}, misfit=misfit)
    group = _Group(task, bench)
    same: list[ListedFile] = []
    rows: IndexRows = {table.name: [] for table in TABLES.values()}
    for url, digest in task.captures:
        result = _examined(url, digest, group)
        if isinstance(result, ListedFile):
            same.append(result)
            continue
        for name, own in result.items():
            rows[name] += [{"capture": url, **row} for row in own]
    tables = {table.name: table.arrow(rows[table.name]) for table in TABLES.values() if rows[table.name]}
    return Done(tables, tuple(same))


def failed(urls: Sequence[str], reason: str, fingerprint: str) -> dict[str, Any]:
    """Return the rows of captures that no worker could read."""
    identity = {"size": -1, "version": "", "gone": False, "settings": fingerprint, "made_by": __version__}
    rows = [{"capture": url, **identity, **_bad(NOT_READ, f"{url}: {reason}")} for url in urls]
    return {"captures": TABLES["captures"].arrow(rows)}


class _Group(msgspec.Struct):
    """A group that is being read.

    Attributes:
        bench: workbench for captures without missions, types and options.
        unfetched: number of consecutive captures that could not be fetched.
    """

    task: Task
    bench: Workbench
    unfetched: int = 0

    def check(self, url: str) -> None:
        """Check that it is worthwhile to request a capture.

        Raises:
            CaptureError: the previous ones could not be fetched.
        """
        if self.unfetched >= _TRIES:
            raise CaptureError(f"{url}: not asked for, as {_TRIES} others could not be fetched; index again")


def _examined(url: str, known_digest: str, group: _Group) -> IndexRows | ListedFile:
    """Return the rows of a capture; if its contents are known, its present listing instead."""
    digest, before = "", ListedFile(url, -1, "")
    try:
        group.check(url)
        before = listed_now(url)
        with at_hand(url) as path:
            digest = _hash(path)
            group.unfetched = 0
            if digest == known_digest and before == listed_now(url):
                return before
            rows = _read(path, url, group)
        changed = f"{url}: changed while it was read; index it again when it is complete"
        state = {} if listed_now(url) == before else _bad(CHANGING, changed)
    except EdorasError as error:
        rows, state = {}, _bad(NOT_READ, str(error))
    except Exception as error:  # noqa: BLE001  whatever is wrong with one capture, others are read
        cause = cause_of(error)
        if is_remote(url) and not digest and not isinstance(cause, FileNotFoundError | PermissionError):
            group.unfetched += 1
        rows, state = {}, _bad(NOT_READ, f"{url}: cannot be read: {reason_of(cause)}")
    if state.get("state") == CHANGING:
        rows, before = {}, ListedFile(url, -1, "")  # not complete yet: the next update reads it
    identity = {"size": before.size, "version": before.version, "sha256": digest or None, "gone": False}
    identity |= {"settings": group.task.fingerprint, "made_by": __version__}
    capture = rows.get("captures", [{}])[0]
    return {**rows, "captures": [{**capture, **state, **identity}]}


def _bad(state: str, reason: str) -> dict[str, Any]:
    return {"state": state, "error": reason}


class _Listening(Counting):
    """Counts datagrams, and keeps the events of cFS's applications."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.events: list[tuple[int, EventRecord]] = []
        self.left_out = 0

    def add(self, rows: ColumnRows, loop: ReadLoop) -> ColumnRows:
        """See ``Counting.add``."""
        own = super().add(rows, loop)
        parts = (part for _, part in own.by_spacecraft())
        events = [(part.context.mission.number, item) for part in parts for item in events_in(*part.alone())]
        events.sort(key=lambda event: event[1].number)
        self.events += events[: _MOST_EVENTS - len(self.events)]
        self.left_out += max(0, len(events) - (_MOST_EVENTS - len(self.events)))
        return own


def _read(path: Path, url: str, group: _Group) -> IndexRows:
    """Read a capture to its end, as far as possible.

    Raises:
        EdorasError: nothing can be read.
    """
    source = open_file(path, url)
    own = source.info.attachments or source.info.definitions or source.info.read_with
    with OnFailure(source.close):
        bench = group.task.settings.workbench(source.info, [path]) if own else group.bench.fresh([path])
    counting = _Listening(source, bench)
    findings = examine(source, bench, counting=counting)
    info = counting.report.summary()
    if counting.left_out:
        info["warnings"] += [f"{plural(counting.left_out, 'event')} more than an index takes"]
    rows = rows_of(info, findings, counting.events, bench.mission.files)
    reason = str(findings.failure) if findings.failure else None
    rows["captures"][0] |= {"state": READ_IN_PART if reason else READ_WHOLE, "error": reason}
    return rows


def _hash(path: Path) -> str:
    digest = sha256()
    with path.open("rb") as file:
        for piece in iter(lambda: file.read(_HASHED_BYTES), b""):
            digest.update(piece)
    return digest.hexdigest()


def rows_of(
    info: Mapping[str, Any],
    findings: Findings,
    events: Sequence[tuple[int, EventRecord]],
    missions: Mapping[str, bytes],
) -> IndexRows:
    """Return the rows of a capture, without the column ``capture``; that of ``captures`` has no identity yet.

    Args:
        info: totals, in the shape of ``info --json``.
        events: events of cFS's applications, each with its spacecraft.
        missions: mission files used for reading, by name.
    """
    doctor = findings.summary()
    streams = doctor["routes"]
    verdicts = [*doctor["verdicts"], *doctor["habits"]]
    worst = findings.diagnosis.worst.label if findings.diagnosis.verdicts else None
    several = any("spacecraft" in row for row in info["routes"])
    warnings = dict.fromkeys([*info["warnings"], *doctor["warnings"]])
    return {
        "captures": [{**_capture(info, doctor), "worst": worst}],
        "routes": [_those(TABLES["routes"], row) for row in info["routes"]],
        "findings": [
            {**_those(TABLES["findings"], row), "finding": name, "datagrams": number}
            for row in info["routes"]
            for name, number in row["findings"].items()
        ],
        "streams": [_those(TABLES["streams"], row) for row in streams],
        "latencies": [item for row in streams for item in _latencies(row)],
        "outcomes": _outcomes(findings),
        "balance": [
            {**_those(TABLES["balance"], row), "came_in": row["in"], "came_out": row["out"]}
            for row in doctor["balance"]
        ],
        "losses": [
            {**_those(TABLES["losses"], row), "cause": cause, "lost": lost}
            for row in doctor["balance"]
            for cause, lost in row["lost_by"].items()
        ],
        "verdicts": [{**_those(TABLES["verdicts"], item), "sent": item["of"]} for item in verdicts],
        "events": [
            {**_event(item), "time": _moment(item.time_ns), "spacecraft": number if several else None}
            for number, item in events
        ],
        "missions": [
            {"file": name, "sha256": sha256(data).hexdigest(), "bytes": len(data)}
            for name, data in missions.items()
        ],
        "warnings": [{"text": text} for text in warnings],
    }


def _capture(info: Mapping[str, Any], doctor: Mapping[str, Any]) -> dict[str, Any]:
    row = _those(TABLES["captures"], {**doctor, **info})
    if not info["datagrams"]:
        return row | dict.fromkeys(("start_ns", "end_ns", "began", "seconds"))
    start_ns, end_ns = info["start_ns"], info["end_ns"]
    return row | {"began": _moment(start_ns), "seconds": (end_ns - start_ns) / 1e9}


def _those(table: IndexTable, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a row for a table's columns."""
    return {name: row[name] for name in table.names if name in row}


def _latencies(row: Mapping[str, Any]) -> Iterable[dict[str, Any]]:
    whose = {name: row.get(name) for name in _SENDERS}
    for part in ("delay", "to_robot"):
        if row[part]:
            yield {**whose, "part": part, **row[part]}
    for item in row["crossings"]:
        if item["latency"]:
            came = {"from_link": item["from_link"], "from_msg_id": item["from"]}
            yield {**whose, "part": "crossing", **came, **item["latency"]}


def _outcomes(findings: Findings) -> list[dict[str, Any]]:
    """Return the sums of each route's rows of the balance; the capture's own losses belong to no route."""
    diagnosis = findings.diagnosis
    rows = sorted((row for row in diagnosis.balance if row.hop != CAPTURE), key=_key)
    outcomes = []
    for _, group in groupby(rows, key=_key):
        members = list(group)
        row_json = members[0].as_json(diagnosis.topics.get(members[0].route))
        figures = {name: sum(getattr(row, name) for row in members) for name in _GONE}
        lost = sum(row.all_lost for row in members)
        route = {name: row_json.get(name) for name in _ROUTE}
        outcomes.append({**route, "sent": sent(members), "lost": lost, **figures})
    return outcomes


def _key(row: Row) -> tuple[int, int, str, int]:
    return row.spacecraft or 0, row.route, row.link, -1 if row.msg_id is None else row.msg_id


def _event(item: EventRecord) -> dict[str, Any]:
    return {name: getattr(item, name) for name in TABLES["events"].names if hasattr(item, name)}


def _moment(time_ns: int) -> datetime | None:
    """Return a time as a date; None if there is none."""
    try:
        return (_EPOCH + timedelta(microseconds=time_ns // 1000)).replace(tzinfo=None)
    except OverflowError:
        return None
