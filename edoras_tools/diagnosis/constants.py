"""Learns constants of the flight side from the capture: periods of rounds, limits, depths.

Rules:

1. The period of a round is the shortest frequent time between two bursts of one sender, if nearly all other
   times are multiples of it. Command Ingest's period shows at the last hop, if no command waits longer than
   one period.
2. The limit of a MsgId at a pipe is the number of messages in its full rounds, if an event names the MsgId at
   that pipe, or if the rounds have more messages than the assumed limit.
3. The events that report losses at an application's pipe are made while Command Ingest hands over a burst. If
   the times between them are no multiples of the assumed period, the shortest are its period, and what came
   in one without an event is the limit of that pipe, if that is no more than the assumed limit.
4. A learned period, limit or depth replaces an assumed one if they differ by more than a tenth. It never
   replaces one that a mission or an option gives.
"""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import command_ingest
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.diagnosis.matching.streams import bursts, full_where_lacking
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, by_key, groups

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.evidence.table import Rows
    from edoras_tools.diagnosis.matching.crossing import Hop

_USUAL: Final = SimProfile()
_BURST_NS: Final = 20 * MILLISECOND
"""Messages that follow each other within this time are one burst."""
_LEAST: Final = 20
"""Least number of times between bursts, or of rounds, that show anything."""
_OFTEN: Final = 0.2
"""Least share of the times that are one period."""
_NEAR: Final = 0.15
"""Share of a period within which times belong to it."""
_BY_EVENTS: Final = 3, 0.5
"""The same where events name the bursts: they are few, and other bursts lose nothing."""
_MULTIPLES: Final = 6
"""Up to so many periods, times have to be multiples of the period,"""
_NEARLY_ALL: Final = 0.8
"""this share of them at least."""
_FULL: Final = 0.3
"""Least share of full rounds."""
_SMALL: Final = 6
"""Larger rounds count as full with one message less."""
_WAITS: Final = 0.7, 1.3
"""The longest delay of nearly all commands is between these shares of the period, as they wait one round."""
_ALIKE: Final = 0.1


def find_round(times: Integers, least: int = _LEAST, often: float = _OFTEN) -> int | None:
    """Return the period, ns, of the rounds in which bursts arrive; None if there is none (rule 1).

    Args:
        times: i64 (n,), times of the messages, ns, in order.
        least: number of times between bursts that is enough.
        often: share of them that has to be one period.
    """
    steps = np.diff(times[np.diff(times, prepend=times[:1] - 2 * _BURST_NS) > _BURST_NS])
    steps = steps[steps < 5 * SECOND]
    if len(steps) < least:
        return None
    first = int(np.quantile(steps, often / 2, method="higher"))
    own = steps[np.abs(steps - first) < 2 * _NEAR * first]
    period = float(np.median(own))
    own = steps[np.abs(steps - period) < _NEAR * period]
    ratio = steps[steps < (_MULTIPLES + 0.5) * period] / period
    fits = np.abs(ratio - np.round(ratio)) < 2 * _NEAR
    return None if len(own) < often * len(steps) or fits.mean() < _NEARLY_ALL else int(period)


class Constants:
    """The constants of a capture's flight side: those that it shows, else the assumed ones.

    Args:
        case: its rows, streams, hops, tracks and reported losses. Whatever follows from constants is not
            asked for.

    Attributes:
        profile: all constants: learned, else assumed.
        rounds: name of a constant to the period in the capture, ns.
        learned: names of constants, and MsgIds of limits, that the capture, the mission or an option shows.
    """

    def __init__(self, case: Case) -> None:
        assumed, rows, streams = case.assumed, case.rows, case.streams
        down = rows.on(lambda link: link.only_from_cfs)
        down &= (rows.duplicates == 0) & (rows.reordered == 0)  # in the order of sending
        sent = [rows.time_ns[own] for _, own in groups(rows.source, np.flatnonzero(down))]
        output = max(sent, key=len, default=rows.time_ns[:0])
        every = {"to_wake_ns": find_round(output), "ci_wake_ns": _ingest(rows, case.hops)}
        self.rounds = {name: period for name, period in every.items() if period}
        learned: dict[str, Any] = {
            name: value
            for name, value in {**_reported(case), **self.rounds}.items()
            if _usual(assumed, name) and abs(value / getattr(assumed, name) - 1) > _ALIKE
        }
        limits = _limits(case) if "to_wake_ns" in self.rounds else {}
        lacking = sum(int(item.missing.sum()) for item in streams if item.link.only_from_cfs)
        overflows = any(track.growth("pipe_overflows") for track in case.tracks.values())
        if overflows and lacking > _ALIKE * len(output) and _usual(assumed, "to_pipe_depth"):
            depth = _full_round(output)
            if 0 < depth < (1 - _ALIKE) * assumed.to_pipe_depth:
                learned["to_pipe_depth"] = depth
        self.profile = replace(assumed, to_limits={**assumed.to_limits, **limits}, **learned)
        self.learned: frozenset[str | int] = frozenset((*self.rounds, *learned, *limits, *assumed.stated))


def _limits(case: Case) -> dict[int, int]:
    """Return MsgId to its limit at Telemetry Output, for each MsgId whose full rounds show it (rule 2)."""
    limits: dict[int, int] = {}
    assumed, streams = case.assumed, case.streams
    at_output = {item.msg_id for item in case.reported_losses if item.kind == "limit" and item.at_output}
    uses = Counter((item.sender, item.msg_id) for item in streams)
    for stream in streams:
        limit = assumed.to_limits.get(stream.msg_id)
        is_usual = limit == _USUAL.to_limits.get(stream.known_id) and stream.msg_id not in assumed.stated
        if not stream.link.only_from_cfs or not is_usual or uses[stream.sender, stream.msg_id] > 1:
            continue  # of two that publish it, neither fills a round
        if stream.duplicates + stream.reordered > _ALIKE * len(stream):
            continue  # a network that doubles and delays changes the rounds
        times = stream.time_ns
        most = _full_round(times)
        # Fewer than assumed, and many missing: the limit is lower. More than assumed: it is higher.
        scarce = stream.msg_id in at_output and int(stream.missing.sum()) > _ALIKE * len(stream)
        lacking = times, stream.missing, most
        scarce = scarce and full_where_lacking(*lacking) and _lacks_often(*lacking)
        if most and (scarce or most > (limit or assumed.to_default_limit)):
            limits[stream.msg_id] = most
    return limits


def _lacks_often(times: Integers, missing: Integers, most: int) -> bool:
    """Return whether many full rounds miss messages, or each misses few; else the reader only paused."""
    begins, sizes = bursts(times, _BURST_NS)
    lacking = np.add.reduceat(missing, begins)
    return bool((lacking[sizes >= most] > 0).mean() >= _FULL or np.median(lacking[lacking > 0]) <= 1)


def _usual(profile: SimProfile, name: str) -> bool:
    """Return whether a constant is still the default of the lab applications, and not given."""
    return bool(name not in profile.stated and getattr(profile, name) == getattr(_USUAL, name))


def _ingest(rows: Rows, hops: Sequence[Hop]) -> int | None:
    """Return the period of Command Ingest's rounds, ns; None if the last hop does not show it (rule 1)."""
    # Commands wait only for Command Ingest on their way to the last hop.
    last = [hop for hop in hops if hop.into.link.only_to_cfs and hop.out.link.last_hop]
    out = [rows.time_ns[hop.out.rows[hop.out_rows]] for hop in last]
    round_ns = find_round(np.sort(np.concatenate(out))) if out else None
    if round_ns is None:
        return None
    delays = np.concatenate([hop.delays_ns for hop in last])
    longest = float(np.quantile(delays, 0.9)) / round_ns if len(delays) else 0.0
    return round_ns if _WAITS[0] < longest < _WAITS[1] else None


def _reported(case: Case) -> dict[str, int]:
    """Return the period of Command Ingest's rounds, ns, and a limit behind it, by events (rule 3)."""
    every = ((item, report) for item, report in case.reported_losses.items() if item.kind == "limit")
    sent = by_key((stream for stream in case.streams if stream.is_command), lambda stream: stream.msg_id)
    own = [one for one in every if one[0].sender == command_ingest.NAME and one[0].msg_id in sent]
    if not own:
        return {}
    item, report = max(own, key=lambda both: both[1].count)
    made_ns = np.sort(case.instances.made_ns[[record.row for record in report.records]])
    begins, lost = bursts(made_ns, _BURST_NS)
    round_ns, steps = find_round(made_ns, *_BY_EVENTS) or 0, np.diff(made_ns[begins])
    ratio = round_ns / case.assumed.ci_wake_ns
    # On a host that is short of time, rounds are late, and the shortest one is the period.
    if not round_ns or abs(ratio - max(1, round(ratio))) < _NEAR or steps.min() < (1 - _NEAR) * round_ns:
        return {}
    sent_ns = np.sort(np.concatenate([stream.time_ns for stream in sent[item.msg_id]]))
    came = np.diff(np.searchsorted(sent_ns, made_ns[begins]))
    limit = int(np.median((came - lost[1:])[steps < (1 + _NEAR) * round_ns]))
    # If more get through, the application reads meanwhile, or requests wake Command Ingest.
    is_less = 0 < limit <= case.assumed.app_msg_limit
    return {"ci_wake_ns": round_ns, "app_msg_limit": limit} if is_less else {}


def _full_round(times: Integers) -> int:
    """Return the number of messages in a full round; 0 if rounds are seldom full.

    A message that arrives while a round is sent may leave with it.
    """
    _, sizes = bursts(times, _BURST_NS)
    if len(sizes) < _LEAST:
        return 0
    most = int(np.quantile(sizes, 0.9))
    return most if float((sizes >= most - (most > _SMALL)).mean()) >= _FULL else 0
