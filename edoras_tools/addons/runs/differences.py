"""Two runs of the same system held against each other, route by route: what is worse in the second one.

Runs last differently long and start at different times, so counts are compared as rates and shares, and
times from each run's own start. The rules:

1. A route that the good run has and the bad run has not is worse, if it is a configured topic or had at
   least ``FEWEST`` messages, and is no event; one that only the bad run has is told.
2. A rate is worse when it is lower by more than the tolerance and the good run had at least ``FEWEST``
   messages; events have no rate.
3. Loss is worse when the good run lost nothing and the bad run lost something, or when its share grew by
   more than ``LOSS_SHARE``; so is what was superseded, and what is not accounted for. All of it is the
   balance's, also what is of no route.
4. A latency is worse when its 99th percentile grew by more than the tolerance and by more than
   ``LATENCY_MS``.
5. Sizes that differ, and findings that only one run has, are told; a finding that came is worse if it is an
   error or a warning.
6. A verdict that came is worse if it is an error or a warning; one that went is told. It is the same one if
   it is of the same rule and MsgId, wherever it was.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping

    Key = tuple[str, str]
    """Link and MsgId."""

FEWEST: Final = 5
LOSS_SHARE: Final = 0.01
LATENCY_MS: Final = 10.0
_EVENTS: Final = frozenset({cfe.EVENT_MSG_ID, cfe.SHORT_EVENT_MSG_ID})
_SERIOUS: Final = frozenset({"error", "warning"})
_GONE: Final = {"lost": "lost", "superseded": "superseded", "unaccounted": "not accounted for"}
"""Figures of the balance that say what did not arrive, and how people are told of them."""


@dataclass(frozen=True, slots=True)
class Run:
    """What is known of one run.

    Attributes:
        info: its totals, in the shape of ``info --json``.
        doctor: its diagnosis, in the shape of ``doctor --json``.
    """

    info: Mapping[str, Any]
    doctor: Mapping[str, Any]

    @property
    def seconds(self) -> float:
        """How long it lasted."""
        return float(self.doctor["end_ns"] - self.doctor["start_ns"]) / 1e9


@dataclass(frozen=True, slots=True)
class RunDifference:
    """One thing that differs.

    Attributes:
        what: ``route``, ``rate_hz``, ``lost``, ``superseded``, ``unaccounted``, ``latency_ms``, ``bytes``,
            ``finding`` or ``verdict``.
        route: topic, name or MsgId; None where it is about the whole run.
        link: the link, or None.
        msg_id: as ``0x0827``, or None.
        good: its value in the good run; None where it is not there.
        bad: its value in the bad run; None where it is not there.
        worse: whether the bad run is worse for it.
        text: one line for people.
    """

    what: str
    route: str | None
    link: str | None
    msg_id: str | None
    good: Any
    bad: Any
    worse: bool
    text: str


def run_differences(
    good: Run, bad: Run, *, tolerance: float, serious: Collection[str]
) -> list[RunDifference]:
    """Return all that differs, what is worse first.

    Args:
        tolerance: share by which rates and latencies may differ, as 0.1.
        serious: labels of the findings that are errors or warnings.
    """
    ours, theirs = _routes(good), _routes(bad)
    changes: list[RunDifference] = []
    for key in sorted({*ours, *theirs}):
        one, other = ours.get(key), theirs.get(key)
        name = (one or other or {})["name"]
        if one is None or other is None:
            text = f"{name} on {key[0]} {'is missing' if other is None else 'is new'}"
            counts = (one or {}).get("count"), (other or {}).get("count")
            worse = one is not None and (one["topic"] or one["count"] >= FEWEST) and not _is_event(key)
            changes.append(RunDifference("route", name, *key, *counts, bool(worse), text))
            continue
        changes += _rates(key, name, one, other, tolerance)
        changes += _gone(key, name, one, other)
        changes += _findings(key, name, one["findings"], other["findings"], serious)
    elsewhere = [_elsewhere(run, {*ours, *theirs}) for run in (good, bad)]
    changes += _gone(None, "of no known route", *elsewhere)
    changes += _verdicts(good, bad)
    return sorted(changes, key=lambda item: not item.worse)


def _is_event(key: Key) -> bool:
    return int(key[1], 16) in _EVENTS


def _gone(
    key: Key | None, name: str, one: Mapping[str, Any], other: Mapping[str, Any]
) -> Iterator[RunDifference]:
    """Compare what did not arrive, of one route or of none."""
    for what, told in _GONE.items():
        was, now = (item[what] / item["sent"] if item["sent"] else 0.0 for item in (one, other))
        worse = now - was > LOSS_SHARE or (not one[what] and bool(other[what]))
        if worse or was - now > LOSS_SHARE:
            text = (
                f"{name}: {other[what]:,} of {other['sent']:,} {told} ({now:.1%}) instead of "
                f"{one[what]:,} of {one['sent']:,} ({was:.1%})"
            )
            link, msg_id = key or (None, None)
            route = name if key else None
            yield RunDifference(what, route, link, msg_id, one[what], other[what], worse, text)


def _rates(
    key: Key, name: str, one: Mapping[str, Any], other: Mapping[str, Any], tolerance: float
) -> Iterator[RunDifference]:
    """Compare rate, latency and sizes of one route."""
    was, now = one["rate_hz"], other["rate_hz"]
    if one["count"] >= FEWEST and not _is_event(key) and abs(now - was) > tolerance * was:
        text = f"{name}: {now:.2f} Hz instead of {was:.2f}"
        yield RunDifference("rate_hz", name, *key, was, now, now < was, text)
    was, now = one["latency_ms"], other["latency_ms"]
    if was is not None and now is not None and abs(now - was) > max(tolerance * was, LATENCY_MS):
        text = f"{name}: 99 % within {now:.1f} ms instead of {was:.1f} ms"
        yield RunDifference("latency_ms", name, *key, was, now, now > was, text)
    if one["bytes"] != other["bytes"]:
        sizes = [
            f"{low:,} to {high:,}" if low != high else f"{low:,}"
            for low, high in (other["bytes"], one["bytes"])
        ]
        text = f"{name}: {sizes[0]} bytes instead of {sizes[1]}"
        yield RunDifference("bytes", name, *key, list(one["bytes"]), list(other["bytes"]), False, text)


def _findings(
    key: Key, name: str, one: Mapping[str, int], other: Mapping[str, int], serious: Collection[str]
) -> Iterator[RunDifference]:
    for label in sorted({*one, *other}):
        if label not in other:
            yield RunDifference(
                "finding", name, *key, one[label], None, False, f"{name}: no {label} any more"
            )
        elif label not in one:
            text = f"{name}: {label} on {other[label]:,} packets, on none before"
            yield RunDifference("finding", name, *key, None, other[label], label in serious, text)


def _verdicts(good: Run, bad: Run) -> Iterator[RunDifference]:
    def keyed(run: Run) -> dict[tuple[Any, ...], Mapping[str, Any]]:
        return {
            (item["rule"], item["link"], item["msg_id"], None if item["msg_id"] else item["hop"]): item
            for item in run.doctor["verdicts"]
        }

    ours, theirs = keyed(good), keyed(bad)
    for key, item in theirs.items():
        if key not in ours:
            worse = item["severity"] in _SERIOUS
            text = f"{item['rule']}: {item['reason']}"
            yield RunDifference("verdict", item["topic"], key[1], key[2], None, item["rule"], worse, text)
    for key, item in ours.items():
        if key not in theirs:
            text = f"{item['rule']} is gone: {item['reason']}"
            yield RunDifference("verdict", item["topic"], key[1], key[2], item["rule"], None, False, text)


def _routes(run: Run) -> dict[Key, dict[str, Any]]:
    """Return one row for each link and MsgId, its senders put together."""
    rows: dict[Key, dict[str, Any]] = {}
    for row in run.info["routes"]:
        if row["msg_id"] is None:
            continue
        key = row["link"], row["msg_id"]
        known = rows.setdefault(
            key,
            {
                "name": row["topic"] or row["name"] or row["msg_id"],
                "topic": bool(row["topic"]),
                "count": 0,
                "bytes": (row["bytes_min"], row["bytes_max"]),
                "findings": defaultdict(int),
                "sent": 0,
                **dict.fromkeys(_GONE, 0),
                "latency_ms": None,
            },
        )
        known["count"] += row["count"]
        low, high = known["bytes"]
        known["bytes"] = min(low, row["bytes_min"]), max(high, row["bytes_max"])
        for label, count in row["findings"].items():
            known["findings"][label] += count
    for row in run.doctor["routes"]:
        known = rows.get((row["link"], row["msg_id"]), {})
        if known:
            known["sent"] += row["sent"]
            both = known["latency_ms"], latency_ms(row)
            known["latency_ms"] = max((item for item in both if item is not None), default=None)
    for row in run.doctor["balance"]:
        known = rows.get((row["link"], row["msg_id"]), {})
        if known:
            for what in _GONE:
                known[what] += row[what]
    for known in rows.values():
        known["rate_hz"] = known["count"] / run.seconds if run.seconds > 0 else 0.0
    return rows


def _elsewhere(run: Run, routes: Collection[Key]) -> dict[str, int]:
    """Return what did not arrive and is of no route, beside all datagrams."""
    rows = [row for row in run.doctor["balance"] if (row["link"], row["msg_id"]) not in routes]
    return {"sent": run.info["datagrams"], **{what: sum(row[what] for row in rows) for what in _GONE}}
