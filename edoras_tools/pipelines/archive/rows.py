"""What ``info`` and ``doctor`` say of a capture, as rows of the index's tables."""

from __future__ import annotations

from datetime import datetime, timedelta
from hashlib import sha256
from itertools import groupby
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.balance import sent
from edoras_tools.older import UTC
from edoras_tools.pipelines.archive.tables import TABLES, IndexTable

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from edoras_tools.diagnosis.balance import Row
    from edoras_tools.diagnosis.evidence.payloads import EventRecord
    from edoras_tools.pipelines.doctor.doctor import Findings

    IndexRows = dict[str, list[dict[str, Any]]]
    """Name of a table to its rows."""

_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)
_ROUTE: Final = ("link", "msg_id", "topic", "name")
_SENDERS: Final = (*_ROUTE, "sender", "receiver", "instance")
_GONE: Final = ("superseded", "waiting", "not_captured", "unaccounted")


def rows_of(
    info: Mapping[str, Any],
    findings: Findings,
    events: Sequence[EventRecord],
    missions: Mapping[str, bytes],
) -> IndexRows:
    """Return the rows of a capture, without the column ``capture``; ``captures`` has one, without identity.

    Args:
        info: its totals, in the shape of ``info --json``.
        events: what applications of cFS said.
        missions: the mission files it was read with, by name.
    """
    doctor = findings.summary()
    streams = doctor["routes"]
    verdicts = [*doctor["verdicts"], *doctor["habits"]]
    worst = findings.diagnosis.worst.label if findings.diagnosis.verdicts else None
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
            {**_those(TABLES["events"], _event(item)), "time": _moment(item.time_ns)} for item in events
        ],
        "missions": [
            {"file": name, "sha256": sha256(data).hexdigest(), "bytes": len(data)}
            for name, data in missions.items()
        ],
        "warnings": [{"text": text} for text in warnings],
    }


def _capture(info: Mapping[str, Any], doctor: Mapping[str, Any]) -> dict[str, Any]:
    there = bool(info["datagrams"])
    start_ns, end_ns = (info["start_ns"], info["end_ns"]) if there else (None, None)
    return {
        **_those(TABLES["captures"], {**doctor, **info}),
        "start_ns": start_ns,
        "end_ns": end_ns,
        "began": _moment(info["start_ns"]) if there else None,
        "seconds": (info["end_ns"] - info["start_ns"]) / 1e9 if there else None,
    }


def _those(table: IndexTable, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a row has of a table's columns."""
    return {name: row[name] for name in table.names if name in row}


def _latencies(row: Mapping[str, Any]) -> Iterable[dict[str, Any]]:
    whose = {name: row[name] for name in _SENDERS}
    for part in ("delay", "to_robot"):
        if row[part]:
            yield {**whose, "part": part, **row[part]}
    for item in row["crossings"]:
        if item["latency"]:
            came = {"from_link": item["from_link"], "from_msg_id": item["from"]}
            yield {**whose, "part": "crossing", **came, **item["latency"]}


def _outcomes(findings: Findings) -> list[dict[str, Any]]:
    """Return the sums of each route's rows of the balance; the capture's own losses are of none."""
    found = findings.diagnosis
    rows = sorted((row for row in found.balance if row.hop != "capture"), key=_key)
    made = []
    for _, group in groupby(rows, key=_key):
        members = list(group)
        told = members[0].as_json(found.topics.get(members[0].route))
        figures = {name: sum(getattr(row, name) for row in members) for name in _GONE}
        lost = sum(row.all_lost for row in members)
        made.append({**{name: told[name] for name in _ROUTE}, "sent": sent(members), "lost": lost, **figures})
    return made


def _key(row: Row) -> tuple[int, str, int]:
    return row.route, row.link, -1 if row.msg_id is None else row.msg_id


def _event(item: EventRecord) -> dict[str, Any]:
    return {name: getattr(item, name) for name in TABLES["events"].names if hasattr(item, name)}


def _moment(time_ns: int) -> datetime | None:
    """Return a time as a date; None where it is none."""
    try:
        return (_EPOCH + timedelta(microseconds=time_ns // 1000)).replace(tzinfo=None)
    except OverflowError:
        return None
