"""Compares runs of the same system, route by route: what is worse in the later runs.

Runs have different durations and start times. So counts are compared as rates and shares, and times from each
run's own start. The rules:

1. With two runs or more on both sides, a figure is worse if its mean changed for the worse by more than the
   tolerance, and the 95 % interval of the difference (Welch) does not contain 0.
2. Else a loss is worse if at most one in 100 equal runs loses that much more, by the spread that the queue
   model gives for the earlier runs (``loss_limits``) and by the observed one. A rate or a delay is worse if
   it changed by more than the tolerance.
3. The tolerance of a loss is one percentage point, or 0 if the earlier runs lost nothing; that of a delay is
   at least 10 ms.
4. A figure of fewer than ``FEWEST`` messages in either run, a delay of fewer than ``FEWEST_DELAYS``, and the
   rate of events, are never worse.
5. A route is worse if most earlier runs have it and most later runs do not, if it is a configured topic or
   had at least ``FEWEST`` messages, and is no event. A finding or verdict is worse if no earlier run and
   most later runs have it, if it is an error or a warning. Verdicts are the same if rule and MsgId are, at
   any place. A route is worse, too, if it lasts for nearly all of each earlier run and only for a part of
   each later one.
6. A field is worse if most later runs leave the range of the earlier ones by more than ``limits`` allows; a
   field from cFS also if it stopped changing. Different sizes are reported.

Limits for the next run come from one or many runs: tolerance intervals, each with its source.

1. A limit holds in 99 of 100 runs like the observed ones, with a confidence of 95 percent.
2. The variation of runs is first assumed. The assumption has the weight of ``_WORTH`` runs beside one
   observed run, and less beside more of them. It is: for a rate, a hundredth and the messages at both ends;
   for a silence and a latency, a quarter plus 150 ms; for a field, a twentieth of its range, or a
   two-hundredth if it is sent to cFS.
3. The variation of a loss comes from the queue model (``run``), with the weight of ``MODEL_WORTH`` runs.
4. If nothing was lost, nothing may be lost.

The answers in a replay are compared with an earlier run of the same input: the first different message.

1. Commands are not compared, because they are the input. Both runs begin with the first command.
2. A value differs if the earlier run had no value near it within ``_WINDOW_NS`` before or after: losses and
   times vary from run to run.
3. A value is near if it is within the ``--tolerance`` of the field, else within a share of the field's range.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import sqrt
from statistics import NormalDist, fmean, pvariance, variance
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import asdict

from edoras_tools import words
from edoras_tools.addons.runs.check import NOTABLE_FINDINGS, TO_END, CheckResult, Figures
from edoras_tools.addons.runs.expectations import LOSS_KEYS, Unit
from edoras_tools.addons.runs.run import Run, TopicValues
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.diagnosis.accounts import latency_ms
from edoras_tools.intervals import MEAN_CONFIDENCE, MeanInterval, t_quantile
from edoras_tools.io.formats.columns import json_value
from edoras_tools.mission import Mission
from edoras_tools.pipelines.workbench import Workbench, open_files
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.addons.runs.run import FieldValues

    Key = tuple[str, str, int]
    """Link, MsgId and spacecraft."""
    Route = Mapping[str, Any]
    Ends = tuple[float, float]
    Place = tuple[str, Key]
    """Name of a route, and its key."""

_DIGITS: Final = 15
"""Most decimals of a number; with more, it is written with an exponent."""
_WORTH: Final = 10
MODEL_WORTH: Final = 100
_RATE: Final = 0.01
_TIME: Final = 0.25
_LEAST_S: Final = 0.15
_SENT: Final = 0.005
_RECEIVED: Final = 0.05
FEWEST: Final = 5
"""Least number of messages of a topic with a rate."""
_EQUAL: Final = 1e-6
_CONTENT: Final = 0.99
"""Share of all runs within a tolerance interval, and of equal runs that lose no more by chance."""


class RunLimit(NamedTuple):
    """A limit for the next run.

    Attributes:
        low: lower bound.
        high: upper bound.
        why: observed values, for a comment.
        suffix: end of the bound's text.
        is_share: whether both bounds are shares.
    """

    low: float
    high: float
    why: str
    suffix: str = ""
    is_share: bool = False

    def text(self, unit: Unit) -> str:
        """Return the limit in the notation of a file of expectations."""
        sign = "%" if self.is_share else "s" if unit is Unit.TIME else ""
        low, high = (_rounded(value, how) for value, how in ((self.low, math.floor), (self.high, math.ceil)))
        if self.is_share:
            high = min(100, _rounded(100 * self.high, math.ceil))
        if unit in {Unit.TIME, Unit.LOSS}:
            return f"at most {high}{sign}" if high else "0"
        return f"{low}" if low == high else f"{low}..{high}{self.suffix}"

    def joined(self, other: RunLimit) -> RunLimit:
        """Return a limit that includes both."""
        low, high = min(self.low, other.low), max(self.high, other.high)
        return self._replace(low=low, high=high, why=other.why)


def _worth(runs: int) -> int:
    return max(1, _WORTH // runs)


def range_text(low: float, high: float, text: Callable[[float], str] = "{:.6g}".format) -> str:
    """Return a range in words: ``1`` or ``1 to 2``."""
    first, last = text(low), text(high)
    return first if first == last else f"{first} to {last}"


def _observed(values: Sequence[float], text: Callable[[float], str]) -> str:
    """Return the range of a value of each run in words."""
    return f"{range_text(min(values), max(values), text)} in {plural(len(values), 'run')}"


def topic_limits(
    runs: Sequence[Figures], spread: float, rate_spread: float
) -> Iterator[tuple[str, RunLimit]]:
    """Yield the limits of one topic by their key.

    Args:
        runs: figures of the topic in each run.
        spread: standard deviation of its losses.
        rate_spread: standard deviation of its losses in front of the capture.
    """
    count = len(runs)
    rates = [item.rate for item in runs if item.rate and item.count >= FEWEST]
    if len(rates) == count:
        fewest = min(item.count for item in runs)
        mean = sum(rates) / count
        own = mean * math.hypot(_RATE, 1 / (fewest * math.sqrt(12)), rate_spread / fewest)
        interval = tolerance_interval(rates, own, _worth(count))
        low = max(interval.low, 0.0)
        lasts = low and all(item.end_silence * (item.rate or 0.0) <= TO_END for item in runs)
        why = _observed(rates, lambda value: f"{value:.4g} Hz")
        yield "rate", RunLimit(low, interval.high, why, " to the end" if lasts else "")
        yield "silence", _time_limit([item.silence for item in runs])
    if sizes := [size for item in runs if item.size is not None for size in item.size]:
        yield "size", RunLimit(min(sizes), max(sizes), f"in {plural(count, 'run')}")
    delays = [item.latency for item in runs if item.latency is not None]
    if len(delays) == count:
        yield "latency", _time_limit(delays)
    yield from loss_limits(runs, spread)


def _time_limit(values: Sequence[float]) -> RunLimit:
    spread = _TIME * sum(values) / len(values) + _LEAST_S
    high = tolerance_interval(values, spread, _WORTH).high  # a longest time is no mean of many
    return RunLimit(0, high, _observed(values, lambda value: f"{value:.3g} s"))


def loss_limits(runs: Sequence[Figures], spread: float) -> Iterator[tuple[str, RunLimit]]:
    """Yield the limits of the losses, by their key; losses that nothing counts have none."""
    if not all(item.sent for item in runs):
        return
    for key in LOSS_KEYS:
        if key == "lost" and any(item.not_counted for item in runs):
            continue
        numbers = [int(getattr(item, key)) for item in runs]
        shares = [number / item.sent for number, item in zip(numbers, runs, strict=True)]
        whole = _observed(shares, "{:.3%}".format)
        if len(runs) == 1:
            whole = f"{numbers[0]:,} of {runs[0].sent:,} in 1 run"
        if not any(numbers):
            yield key, RunLimit(0, 0, whole)
            continue
        if key == "lost":
            expected, worth = max(spread, 1.0), MODEL_WORTH
        else:
            expected, worth = math.sqrt(max(numbers)), _worth(len(runs))
        high = tolerance_interval(shares, expected / min(item.sent for item in runs), worth).high
        yield key, RunLimit(0, min(1.0, high), whole, is_share=True)


def field_limit(runs: Sequence[FieldValues], *, to_cfs: bool) -> RunLimit | None:
    """Return the limit of a field; None if it has no number, or was still moving at the end of runs."""
    if not all(item.count for item in runs) or 2 * sum(item.is_moving for item in runs) > len(runs):
        return None
    lows, highs = [item.low for item in runs], [item.high for item in runs]
    span = max(highs) - min(lows)
    if span and runs[0].is_flag:
        return None
    why = f"{range_text(min(lows), max(highs), _number)} in {plural(len(runs), 'run')}"
    if not span:
        margin = 0.0 if runs[0].is_whole else _EQUAL * abs(lows[0])
        return RunLimit(lows[0] - margin, highs[0] + margin, why)
    spread = span * (_SENT if to_cfs else _RECEIVED)
    worth = _worth(len(runs))
    low, high = tolerance_interval(lows, spread, worth).low, tolerance_interval(highs, spread, worth).high
    if runs[0].is_whole:
        return RunLimit(math.floor(low), math.ceil(high), why)
    step = 10.0 ** (math.floor(math.log10(span)) - 3)
    return RunLimit(math.floor(low / step) * step, math.ceil(high / step) * step, why)


def field_filter(name: str, limit: RunLimit, *, is_flag: bool = False) -> str:
    """Return the filter that a field within its limit passes."""
    if is_flag:
        return f"{name} == {'true' if limit.low else 'false'}"
    low, high = _number(limit.low), _number(limit.high)
    return f"{name} == {low}" if low == high else f"{name} in {low}..{high}"


def _number(value: float) -> str:
    """Return a number without an exponent, unless it is too small."""
    if value == int(value):
        return f"{int(value)}"
    digits = max(1, 7 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits <= _DIGITS else repr(value)


def _rounded(value: float, how: Callable[[float], int]) -> float:
    """Return a value with three digits, rounded up or down by ``how``."""
    digits = 2 - math.floor(math.log10(value)) if value > 0 else 0
    scale = 10.0**digits
    rounded = how(round(value * scale, 6)) / scale
    return int(rounded) if rounded == int(rounded) else rounded


def tolerance_interval(values: Sequence[float], spread: float, freedom: int) -> MeanInterval:
    """Return the interval that contains ``_CONTENT`` of all runs, with confidence ``MEAN_CONFIDENCE``.

    Args:
        values: one value of each run, at least one.
        spread: standard deviation assumed before any run.
        freedom: number of runs that the assumption has the weight of.
    """
    count = len(values)
    squares = variance(values) * (count - 1) if count > 1 else 0.0
    total = freedom + count - 1
    deviation = math.sqrt((squares + freedom * spread * spread) / total)
    normal = NormalDist()
    part = 2 / (9 * total)
    chi_square = total * (1 - part + normal.inv_cdf(1 - MEAN_CONFIDENCE) * math.sqrt(part)) ** 3
    half = normal.inv_cdf((1 + _CONTENT) / 2) * math.sqrt((1 + 1 / count) * total / chi_square) * deviation
    mean = fmean(values)
    return MeanInterval(mean, mean - half, mean + half)


FEWEST_DELAYS: Final = 20
LOSS_SHARE: Final = 0.01
LATENCY_MS: Final = 10.0
_EVENTS: Final = frozenset({cfe.EVENT_MSG_ID, cfe.SHORT_EVENT_MSG_ID})
_SERIOUS: Final = frozenset({"error", "warning"})
_WHOLE: Final = 0.9
_PART: Final = 0.6
"""Shares of a run for which a route lasts, by its count and rate: nearly all of it, and only a part."""
_GONE: Final = {"lost": "lost", "superseded": "superseded", "unaccounted": "not accounted for"}
"""Figures of the balance for messages that did not arrive, with their words for people."""


class RunSummary(msgspec.Struct, frozen=True):
    """The compared facts of one run.

    Attributes:
        info: totals, in the shape of ``info --json``.
        doctor: diagnosis, in the shape of ``doctor --json``; empty for a recording without datagrams.
        values: values of the fields of each topic.
        spreads: see ``Run``; MsgIds as text.
        mission: mission, which names spacecraft.
    """

    info: Mapping[str, Any]
    doctor: Mapping[str, Any]
    values: Mapping[str, TopicValues] = msgspec.field(default_factory=dict)
    spreads: Mapping[Key, float] = msgspec.field(default_factory=dict)
    mission: Mission = msgspec.field(default_factory=Mission)

    @classmethod
    def of(cls, run: Run) -> RunSummary:
        """Return the summary of a run."""
        nothing = {"routes": [], "balance": [], "verdicts": [], "lost": 0}
        doctor = nothing if run.diagnosis is None else run.diagnosis.as_json()
        spreads = {(link, f"0x{msg_id:04x}", own): item for (link, msg_id, own), item in run.spreads.items()}
        return cls(run.report.summary(), doctor, run.values, spreads, run.context.mission)

    @property
    def seconds(self) -> float:
        """Duration, s."""
        times = self.doctor if "start_ns" in self.doctor else self.info
        return float(times["end_ns"] - times["start_ns"]) / 1e9


class Point(msgspec.Struct, frozen=True):
    """One figure or field of a route in the earlier and the later runs.

    Attributes:
        what: kind: ``route``, ``rate_hz``, ``lost``, ``superseded``, ``unaccounted``, ``latency_ms``,
            ``bytes``, ``finding``, ``verdict`` or ``value``; for limits ``max_loss`` and ``max_delay``.
        route: topic, name or MsgId; None for the whole run.
        link: the link, or None.
        msg_id: MsgId as ``0x0827``, or None.
        good: value in earlier runs, the mean of several; None if they have none.
        bad: value in later runs; None if they have none.
        worse: whether the later runs are worse in this.
        text: one line for people.
        differs: whether it is reported.
        field: name of the field, for a value.
        interval: 95 % interval of the difference, if both sides have two runs or more.
        first: for a value, number of the first message that differs, and its time from the run's start, s.
    """

    what: str
    route: str | None
    link: str | None
    msg_id: str | None
    good: Any
    bad: Any
    worse: bool
    text: str
    differs: bool = True
    field: str | None = None
    interval: tuple[float, float] | None = None
    first: tuple[int, float] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the point in the shape of ``compare --json``."""
        values = {name: json_value(value) for name, value in asdict(self).items()}
        return {name: value for name, value in values.items() if name != "differs"}

    def result(self) -> CheckResult:
        """Return the point as a result for JUnit."""
        name = f"{self.what} {self.field}" if self.field else self.what
        return CheckResult(self.route or self.link or "run", name, None, self.text, not self.worse)


class DifferenceLimits(msgspec.Struct, frozen=True):
    """The accepted differences, and absolute limits of later runs.

    Attributes:
        tolerance: largest relative difference of rates and delays, as 0.1.
        rooms: name of a field to its tolerance outside its range.
        max_loss: pattern of routes, empty for all, to the largest share of lost messages.
        max_delay: pattern of routes, empty for all, to the largest 99th percentile of the delay, ms.
    """

    tolerance: float = 0.1
    rooms: Mapping[str, float] = msgspec.field(default_factory=dict)
    max_loss: Sequence[tuple[str, float]] = ()
    max_delay: Sequence[tuple[str, float]] = ()


def compare_runs(
    good: Sequence[RunSummary], bad: Sequence[RunSummary], bounds: DifferenceLimits
) -> list[Point]:
    """Return every figure that both sides have, and all other differences; worse ones come first.

    Args:
        good: earlier runs, at least one.
        bad: later runs.
    """
    sides = [[_lasting(run, _routes(run)) for run in side] for side in (good, bad)]
    points: list[Point] = []
    for key in sorted({key for side in sides for rows in side for key in rows}):
        ours, theirs = ([rows[key] for rows in side if key in rows] for side in sides)
        points += _presence(key, ours, theirs, len(good), len(bad))
        if ours and theirs:
            points += _figures(key, ours, theirs, bounds)
            points += _findings(key, ours, theirs)
        points += _limits(key, theirs, bounds)
    keys = {key for side in sides for rows in side for key in rows}
    elsewhere = [[_elsewhere(run, keys) for run in side] for side in (good, bad)]
    points += _gone(None, *elsewhere)
    points += _verdicts(good, bad)
    points += _values(good, bad, bounds)
    return sorted(points, key=lambda item: (not item.worse, not item.differs))


def _most(some: int, of: int) -> bool:
    return 2 * some > of


def _is_event(key: Key) -> bool:
    return int(key[1], 16) in _EVENTS


def _presence(
    key: Key, ours: Sequence[Route], theirs: Sequence[Route], good: int, bad: int
) -> Iterator[Point]:
    before, after = _most(len(ours), good), _most(len(theirs), bad)
    if before == after:
        return
    row = (ours or theirs)[0]
    was, now = (sum(item["count"] for item in side) or None for side in (ours, theirs))
    weighty = bool(row["topic"]) or any(item["count"] >= FEWEST for item in ours)
    text = f"{row['name']} on {key[0]} {'is missing' if before else 'is new'}"
    worse = before and weighty and not _is_event(key)
    yield Point("route", row["name"], *key[:2], was, now, worse, text)


def _difference(ours: Sequence[float], theirs: Sequence[float], step: float = 0.0) -> Ends | None:
    """Return the interval of a difference; None if one side has fewer than two runs."""
    return difference_interval(ours, theirs, step)[1:] if min(len(ours), len(theirs)) > 1 else None


def _figures(
    key: Key, ours: Sequence[Route], theirs: Sequence[Route], bounds: DifferenceLimits
) -> Iterator[Point]:
    """Compare rate, losses, delay and sizes of one route."""
    name = ours[0]["name"]
    if not _is_event(key) and min(item["count"] for item in (*ours, *theirs)) >= FEWEST:
        was, now = ([item["rate_hz"] for item in side] for side in (ours, theirs))
        yield _moved("rate_hz", (name, key), was, now, bounds.tolerance * fmean(was))
        yield from _partly((name, key), ours, theirs)
    yield from _gone((name, key), ours, theirs)
    was, now = (
        [item["latency_ms"] for item in side if item["latency_ms"] is not None] for side in (ours, theirs)
    )
    if was and now and min(item["delays"] for item in (*ours, *theirs)) >= FEWEST_DELAYS:
        least = max(bounds.tolerance * fmean(was), LATENCY_MS)
        yield _moved("latency_ms", (name, key), was, now, least)
    lows, highs = ([[item["bytes"][at] for item in side] for side in (ours, theirs)] for at in (0, 1))
    sizes = [(min(low), max(high)) for low, high in zip(lows, highs, strict=True)]
    if sizes[0] != sizes[1]:
        before, after = (f"{low:,} to {high:,}" if low != high else f"{low:,}" for low, high in sizes)
        text = f"{name}: {after} bytes instead of {before}"
        yield Point("bytes", name, *key[:2], [*sizes[0]], [*sizes[1]], False, text)


def _partly(place: Place, ours: Sequence[Route], theirs: Sequence[Route]) -> Iterator[Point]:
    """Compare for how long a route lasts: nearly all of earlier runs, and a part of later ones."""
    least, most = min(item["lasts"] for item in ours), max(item["lasts"] for item in theirs)
    was, now = (fmean(item["count"] for item in side) for side in (ours, theirs))
    if least > _WHOLE and most < _PART:
        text = f"{place[0]} comes for {most:.0%} of the time instead of {least:.0%}"
        yield Point("route", place[0], *place[1][:2], was, now, True, text)


def _moved(quantity: str, place: Place, was: Sequence[float], now: Sequence[float], least: float) -> Point:
    """Compare a rate, where less is worse, or a delay, where more is worse."""
    before, after = fmean(was), fmean(now)
    ends = _difference(was, now)
    differs = abs(after - before) > least and (ends is None or not ends[0] <= 0 <= ends[1])
    worse = differs and (after < before) == (quantity == "rate_hz")
    name, key = place
    word, text = ("", words.rate) if quantity == "rate_hz" else ("99 % within ", words.milliseconds)
    line = f"{name}: {word}{text(after)} instead of {text(before)}"
    return Point(quantity, name, *key[:2], before, after, worse, line, differs, interval=ends)


def _gone(place: Place | None, ours: Sequence[Route], theirs: Sequence[Route]) -> Iterator[Point]:
    """Compare the messages that did not arrive, of one route or of none."""
    name, (link, msg_id, _) = place or ("of no known route", (None, None, 0))
    route = name if place else None
    for quantity, label in _GONE.items():
        counts = [[(item[quantity], item["sent"]) for item in side] for side in (ours, theirs)]
        sent = [number for side in counts for _, number in side]
        if not any(sent):
            continue
        shares = [[number / of if of else 0.0 for number, of in side] for side in counts]
        before, after = map(fmean, shares)
        step = 1 / max(1, min(sent))
        ends = _difference(shares[0], shares[1], step)
        spread = step * max(item["spread"] for item in ours)
        chance = _is_chance(shares, spread) if ends is None else ends[0] <= 0 <= ends[1]
        least = LOSS_SHARE if before else 0.0
        differs = abs(after - before) > least and not chance
        enough = place is None or min(sent for _, sent in counts[1]) >= FEWEST
        (was, of), (now, now_of) = ([sum(column) for column in zip(*side, strict=True)] for side in counts)
        text = (
            f"{name}: {now:,} of {now_of:,} {label} ({after:.1%}) instead of {was:,} of {of:,} ({before:.1%})"
        )
        values = (was, now) if ends is None else (before, after)
        worse = differs and after > before and enough
        yield Point(quantity, route, link, msg_id, values[0], values[1], worse, text, differs, interval=ends)


def _is_chance(shares: Sequence[Sequence[float]], spread: float) -> bool:
    """Return whether the loss of a single run is possible for runs like those of the other side.

    Args:
        shares: shares of both sides; one side has one run.
        spread: standard deviation of earlier runs, from the model.
    """
    one, others = sorted(shares, key=len)
    freedom = MODEL_WORTH + len(others) - 1
    squares = MODEL_WORTH * spread**2 + pvariance(others) * len(others)
    moved, deviation = abs(one[0] - fmean(others)), sqrt(squares / freedom * (1 + 1 / len(others)))
    return all(map(any, shares)) and moved <= t_quantile(_CONTENT, freedom) * deviation


def _limits(key: Key, theirs: Sequence[Route], limits: DifferenceLimits) -> Iterator[Point]:
    """Compare later runs with the limits that the user set."""
    sent = sum(item["sent"] for item in theirs)
    share = sum(item["lost"] + item["unaccounted"] for item in theirs) / sent if sent else None
    delay = max((item["latency_ms"] for item in theirs if item["latency_ms"] is not None), default=None)
    for quantity, patterns, value, text in (
        ("max_loss", limits.max_loss, share, "{:.2%} lost".format),
        ("max_delay", limits.max_delay, delay, "99 % within {:.1f} ms".format),
    ):
        for pattern, most in patterns if theirs else ():
            name = theirs[0]["name"]
            if value is not None and pattern in {"", name.removeprefix("/"), key[1]}:
                line = f"{name}: {text(value)}, allowed {text(most)}"
                yield Point(quantity, name, *key[:2], most, value, value > most, line, value > most)


def _findings(key: Key, ours: Sequence[Route], theirs: Sequence[Route]) -> Iterator[Point]:
    name = ours[0]["name"]
    for label in sorted({label for row in (*ours, *theirs) for label in row["findings"]}):
        before, after = ([row["findings"].get(label, 0) for row in side] for side in (ours, theirs))
        if not any(after):
            text = f"{name}: no {label} any more"
            yield Point("finding", name, *key[:2], sum(before), None, False, text)
        elif not any(before):
            text = f"{name}: {label} on {sum(after):,} packets, on none before"
            worse = label in NOTABLE_FINDINGS and _most(sum(map(bool, after)), len(after))
            yield Point("finding", name, *key[:2], None, sum(after), worse, text)


def _verdicts(good: Sequence[RunSummary], bad: Sequence[RunSummary]) -> Iterator[Point]:
    def keyed(run: RunSummary) -> dict[tuple[Any, ...], Mapping[str, Any]]:
        return {
            (item["rule"], *_key(item), None if item["msg_id"] else item["hop"]): item
            for item in run.doctor["verdicts"]
        }

    ours, theirs = ([keyed(run) for run in side] for side in (good, bad))
    every = {key: item for run in (*ours, *theirs) for key, item in run.items()}
    for key, item in every.items():
        before, after = (sum(key in run for run in side) for side in (ours, theirs))
        if not before:
            worse = item["severity"] in _SERIOUS and _most(after, len(theirs))
            text = f"{item['rule']}: {item['reason']}"
            yield Point("verdict", item["topic"], key[1], key[2], None, item["rule"], worse, text)
        elif not after:
            text = f"{item['rule']} is gone: {item['reason']}"
            yield Point("verdict", item["topic"], key[1], key[2], item["rule"], None, False, text)


def _values(
    good: Sequence[RunSummary], bad: Sequence[RunSummary], bounds: DifferenceLimits
) -> Iterator[Point]:
    """Compare the fields of the topics that all runs have."""
    for topic in good[0].values:
        ours, theirs = ([run.values[topic] for run in side if topic in run.values] for side in (good, bad))
        if len(ours) < len(good) or not theirs:
            continue
        for name in ours[0].fields:
            before = [item.fields[name] for item in ours if name in item.fields]
            after = [(run, item) for run, item in zip(bad, theirs, strict=False) if name in item.fields]
            if len(before) == len(ours) and after:
                yield from _value((topic, name), ours[0].to_cfs, before, after, bounds)


def _value(
    place: tuple[str, str],
    to_cfs: bool,
    before: Sequence[FieldValues],
    after: Sequence[tuple[RunSummary, TopicValues]],
    bounds: DifferenceLimits,
) -> Iterator[Point]:
    topic, name = place
    limit = field_limit(before, to_cfs=to_cfs)
    if limit is None:
        return
    room = bounds.rooms.get(name)
    low, high = limit.low, limit.high
    if room is not None:
        low, high = min(item.low for item in before) - room, max(item.high for item in before) + room
    fields = [item.fields[name] for _, item in after]
    text = f"{topic} {name}: {_range(fields)} instead of {_range(before)}"
    was, now = (fmean([item.mean for item in side if item.count] or [np.nan]) for side in (before, fields))
    had_none = any(np.isnan(item.first_values).any() for item in before)
    outliers: list[tuple[tuple[int, float], float]] = []
    for run, item in after:
        values = item.fields[name].first_values
        outside = np.flatnonzero(~((values >= low) & (values <= high)) & ~(np.isnan(values) & had_none))
        if len(outside):
            number, time_ns = item.place(int(outside[0]))
            outliers.append(((number, (time_ns - run.info["start_ns"]) / 1e9), float(values[outside[0]])))
    if outliers:
        first, value = outliers[0]
        text += f"; first {value:.6g} in message {first[0]:,} at {first[1]:.3f} s"
        worse = _most(len(outliers), len(after))
        yield Point("value", topic, None, None, was, now, worse, text, field=name, first=first)
        return
    stuck = not to_cfs and all(item.is_constant and item.count >= FEWEST_DELAYS for item in fields)
    stuck = stuck and not any(item.is_constant for item in before)
    text += "; it does not change any more" if stuck else ""
    yield Point("value", topic, None, None, was, now, stuck, text, stuck, field=name)


def _range(values: Sequence[FieldValues]) -> str:
    return range_text(min(item.low for item in values), max(item.high for item in values))


def _routes(run: RunSummary) -> dict[Key, dict[str, Any]]:
    """Return one row for each link and MsgId, with the sums of its senders; rates are those of the doctor."""
    rows: dict[Key, dict[str, Any]] = {}
    for row in run.info["routes"]:
        if row["msg_id"] is None:
            continue
        key = _key(row)
        entry = rows.setdefault(
            key,
            {
                "name": run.mission.own_name(row["topic"] or row["name"] or row["msg_id"], key[2]),
                "topic": bool(row["topic"]),
                "bytes": (row["bytes_min"], row["bytes_max"]),
                "findings": defaultdict(int),
                **dict.fromkeys(("count", "sent", "delays", *_GONE), 0),
                "latency_ms": None,
                "rate_hz": 0.0,
                "spread": run.spreads.get(key, 0.0),
            },
        )
        entry["count"] += row["count"]
        low, high = entry["bytes"]
        entry["bytes"] = min(low, row["bytes_min"]), max(high, row["bytes_max"])
        for label, count in row["findings"].items():
            entry["findings"][label] += count
    judged = {*map(_key, run.doctor["routes"])}
    others = [row for row in run.info["routes"] if _key(row) not in judged]
    for row in (*run.doctor["routes"], *others):
        if entry := rows.get(_key(row), {}):
            entry["rate_hz"] += row["rate_hz"]
    for row in run.doctor["routes"]:
        if entry := rows.get(_key(row), {}):
            entry["sent"] += row["sent"]
            entry["delays"] += row["seen"]
            both = entry["latency_ms"], latency_ms(row)
            entry["latency_ms"] = max((item for item in both if item is not None), default=None)
    for row in run.doctor["balance"]:
        if entry := rows.get(_key(row), {}):
            for quantity in _GONE:
                entry[quantity] += row[quantity]
    return rows


def _lasting(run: RunSummary, rows: dict[Key, dict[str, Any]]) -> dict[Key, dict[str, Any]]:
    """Return routes with the share of the run for which each lasts, by its count and rate."""
    end_ns, start_ns = (run.doctor.get(name) or 0 for name in ("end_ns", "start_ns"))
    seconds = (end_ns - start_ns) / SECOND
    for row in rows.values():
        row["lasts"] = row["count"] / (row["rate_hz"] * seconds) if row["rate_hz"] and seconds else 1.0
    return rows


def _key(row: Mapping[str, Any]) -> Key:
    return row["link"], row["msg_id"], row.get("spacecraft", FIRST_SPACECRAFT)


def _elsewhere(run: RunSummary, routes: set[Key]) -> dict[str, Any]:
    """Return the messages that did not arrive and belong to no route, compared with all datagrams."""
    rows = [row for row in run.doctor["balance"] if _key(row) not in routes]
    losses = {quantity: sum(row[quantity] for row in rows) for quantity in _GONE}
    return {"sent": run.info["datagrams"], "spread": 0.0, **losses}


def comparison_json(
    good: Sequence[RunSummary], bad: Sequence[RunSummary], points: Sequence[Point]
) -> dict[str, Any]:
    """Return a comparison in the shape of ``compare --json``."""

    def side(runs: Sequence[RunSummary]) -> dict[str, Any]:
        return {
            "source": runs[0].info["source"] if len(runs) == 1 else f"{len(runs)} runs",
            "runs": len(runs),
            "datagrams": sum(run.info["datagrams"] for run in runs),
            "seconds": sum(run.seconds for run in runs),
            "lost": sum(run.doctor["lost"] for run in runs),
        }

    return {
        "good": side(good),
        "bad": side(bad),
        "worse": any(item.worse for item in points),
        "changes": [item.as_json() for item in points if item.differs],
        "points": [item.as_json() for item in points],
    }


def difference_interval(before: Sequence[float], after: Sequence[float], step: float = 0.0) -> MeanInterval:
    """Return by how much the mean of later runs is above that of earlier ones (Welch's interval).

    Args:
        before: values of at least two runs.
        after: values of at least two later runs.
        step: see ``mean_interval``.
    """
    parts = [(variance(item) + step * step / 12) / len(item) for item in (before, after)]
    mean, whole = fmean(after) - fmean(before), sum(parts)
    if not whole:
        return MeanInterval(mean, mean, mean)
    below = sum(part**2 / (len(item) - 1) for part, item in zip(parts, (before, after), strict=True))
    half = t_quantile((1 + MEAN_CONFIDENCE) / 2, max(1, int(whole**2 / below))) * sqrt(whole)
    return MeanInterval(mean, mean - half, mean + half)


_WINDOW_NS: Final = SECOND
_PERCENT: Final = 10.0
_PERIODS: Final = 1.5
"""Least window, as a multiple of the usual time between two messages."""


def unlike(good: Path, sent: Path, bench: Workbench, rooms: Mapping[str, float]) -> list[str]:
    """Return the first difference of each field from a good run, one line for each.

    Args:
        good: a capture of the good run.
        sent: recording of the other run.
        bench: workbench for both.
        rooms: name of a field to its tolerance; with the empty name, the tolerance of all other fields in
            percent of their range.

    Raises:
        EdorasError: one of them cannot be read to its end.
    """
    runs = [Run.read(open_files([path]), bench.fresh()) for path in (good, sent)]
    for failure in (run.findings.failure for run in runs):
        if failure is not None:
            raise failure
    return list(unlike_lines(runs[0], runs[1], rooms))


def unlike_lines(good: Run, sent: Run, rooms: Mapping[str, float]) -> Iterator[str]:
    """Yield the lines of ``unlike`` for runs that are already read."""
    begins = [_begin_ns(run) for run in (good, sent)]
    for topic, ours in good.values.items():
        if ours.to_cfs:
            continue
        if topic not in sent.values:
            yield f"{topic} did not come"
            continue
        yield from _unlike_fields(topic, (ours, sent.values[topic]), begins, rooms)


def _begin_ns(run: Run) -> int:
    """Return the time of the first command, ns since 1970; without commands, the begin of the run."""
    times = [int(item.times_ns[0]) for item in run.values.values() if item.to_cfs and len(item.times_ns)]
    return min(times, default=run.ledger.start_ns)


def _unlike_fields(
    topic: str, sides: tuple[TopicValues, TopicValues], begins: list[int], rooms: Mapping[str, float]
) -> Iterator[str]:
    ours, theirs = sides
    times = [item.times_ns - begin_ns for item, begin_ns in zip(sides, begins, strict=True)]
    step_ns = float(np.median(np.diff(times[0]))) if len(times[0]) > 1 else 0.0
    window_ns = max(_WINDOW_NS, int(_PERIODS * step_ns))
    first = np.searchsorted(times[0], times[1] - window_ns)
    end = np.searchsorted(times[0], times[1] + window_ns, "right")
    for name, field in ours.fields.items():
        if name not in theirs.fields or not field.count:
            continue
        room = rooms.get(name, rooms.get("", _PERCENT) / 100 * (field.high - field.low))
        low, high = _extremes(field.first_values, first, end)
        values = theirs.fields[name].first_values
        outside = (values < low - room) | (values > high + room) | (np.isnan(values) & ~np.isnan(low))
        if outside.any():
            place = int(outside.argmax())
            number, time_ns = theirs.place(place)
            yield (
                f"{topic} {name} is {values[place]:.6g} in message {number:,}, "
                f"{(time_ns - begins[1]) / SECOND:.3f} s after the first command; "
                f"it was {range_text(low[place], high[place])} then"
            )


def _extremes(
    values: NDArray[np.float64], first: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the smallest and the largest value of each ``values[first:end]``; NaN for an empty one."""
    low = np.full(len(first), np.nan)
    high = low.copy()
    some = np.flatnonzero(end > first)
    if len(some):
        bounds = np.stack((first[some], end[some]), axis=1).ravel()
        padded = np.append(values, values[-1])
        low[some] = np.minimum.reduceat(padded, bounds)[::2]
        high[some] = np.maximum.reduceat(padded, bounds)[::2]
    return low, high
