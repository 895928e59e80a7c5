"""Remedies for queues that lose messages, the losses that would remain with them.

Rules:

1. Arrivals are those in the capture. Lost messages are placed evenly between the messages around them.
2. The capture shows the reading rounds of a queue, but not their exact times. So the model runs with several
phases, and its worst result counts.
3. The model must explain the actual losses before it predicts any. It may lose up to twice as many: its
   reader
takes no message while a burst still arrives.
4. Beside a slower rate, a higher limit at Telemetry Output is offered only if then this MsgId loses nothing
   and the others lose no more.
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.lib.stride_tricks import sliding_window_view

from edoras_tools.cfs import queues, telemetry_output
from edoras_tools.diagnosis.accounting.losses import TAIL_NS, Loss
from edoras_tools.diagnosis.accounting.pipes import more_at_once
from edoras_tools.diagnosis.case import keep_results
from edoras_tools.diagnosis.evidence.copies import crowding, senders_at_once
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import Change, StateOwner, StateSpan
from edoras_tools.diagnosis.matching.streams import Stream, full_where_lacking
from edoras_tools.diagnosis.verdict import Advice
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.cfe import EVENT_MSG_ID
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.wire.arrays import Integers, Mask, Places


LET_RUN: Final = "look at the load of its host, and at who may stop its process (a debugger, SIGSTOP)"
"""Remedy if a whole cFS stood still: no rate and no limit helps then."""
_PHASES: Final = 4
_ROUNDS: Final = 1000
"""Rounds before and behind the middle of the worst loss that the model simulates."""
_FULL: Final = 0.3
"""Least share of full rounds from which the size of a round shows the limit."""
_LATE: Final = 1.01
"""Largest length of a round, as a multiple of its nominal length."""
_FITS: Final = 0.5, 1.2
_FEW: Final = 5
"""The model explains losses between these shares of its own losses, give or take ``_FEW`` messages."""
_MOSTLY: Final = 0.9
"""Share of the datagrams to CI with which one MsgId fills its socket alone."""
_STEPS: Final = 5
"""Steps between messages whose median is the usual distance of the next ones."""
_PAUSE: Final = 2
"""Least length of a pause, in rounds."""
_MOST: Final = 255
"""Highest limit in Telemetry Output's table."""
_WHILE_NS: Final = 10 * SECOND
"""Time over which a mean rate is compared with the queue's rate, to tell bursts from too high a rate."""


class Arrivals(NamedTuple):
    """Messages that arrive at a queue, in order of time.

    Attributes:
        time_ns: i64 (n,), times of arrival, ns.
        msg_id: i64 (n,), MsgIds.
    """

    time_ns: Integers
    msg_id: Integers

    def take(self, rows: Places | Mask) -> Arrivals:
        """Return the arrivals of some rows: places or a mask."""
        return Arrivals(self.time_ns[rows], self.msg_id[rows])

    def only(self, msg_id: int) -> Arrivals:
        """Return the arrivals of one MsgId."""
        return self.take(self.msg_id == msg_id)

    def between(self, start_ns: int, end_ns: int) -> Arrivals:
        """Return the arrivals of a span of time, both ends included."""
        first, last = np.searchsorted(self.time_ns, (start_ns, end_ns + 1))
        return Arrivals(self.time_ns[first:last], self.msg_id[first:last])

    def around(self, loss: Loss, round_ns: int) -> Arrivals:
        """Return the arrivals in the rounds around a loss that the model simulates."""
        middle_ns, margin_ns = (loss.start_ns + loss.end_ns) // 2, _ROUNDS * round_ns
        return self.between(middle_ns - margin_ns, middle_ns + margin_ns)

    def spaced(self, gap_ns: float, msg_id: int) -> Arrivals:
        """Return the arrivals with at least ``gap_ns`` between two of a MsgId, each as early as possible."""
        own = self.msg_id == msg_id
        steps = (np.arange(int(own.sum())) * gap_ns).astype(np.int64)
        time_ns = self.time_ns.copy()
        time_ns[own] = np.maximum.accumulate(time_ns[own] - steps) + steps
        return Arrivals(time_ns, self.msg_id).take(np.argsort(time_ns, kind="stable"))

    def most(self, window_ns: float) -> int:
        """Return the largest number of arrivals within a window of time."""
        last = np.searchsorted(self.time_ns, self.time_ns + int(window_ns))
        return int((last - np.arange(len(last))).max(initial=0))

    def rate(self) -> int:
        """Return the largest number of arrivals in a second; jitter of a steady sender does not add one."""
        step_ns = np.median(np.diff(self.time_ns)) if len(self.time_ns) > 1 else 0
        return self.most(SECOND - step_ns / 2)

    def lost(self, way: Sequence[queues.Queue], msg_id: int, phases: int = _PHASES) -> list[int]:
        """Return how many messages of a MsgId a chain of queues loses, at each of several phases."""
        return [own for own, _ in self.lost_of(way, msg_id, phases)]

    def lost_of(self, way: Sequence[queues.Queue], msg_id: int, phases: int) -> list[tuple[int, int]]:
        """Return the losses of a MsgId and of all others in a chain of queues, at each of several phases."""
        return [self._lost(way, msg_id, at * way[-1].round_ns // phases) for at in range(phases)]

    def _lost(self, way: Sequence[queues.Queue], msg_id: int, phase_ns: int) -> tuple[int, int]:
        inside = self
        for queue in way:
            kinds = np.zeros_like(inside.msg_id) if queue.is_socket else inside.msg_id
            passed = queues.pass_queue(replace(queue, phase_ns=phase_ns), inside.time_ns, kinds)
            out = passed.delivered
            inside = Arrivals(passed.left_ns[out], inside.msg_id[out])
        own = int((self.msg_id == msg_id).sum() - (inside.msg_id == msg_id).sum())
        return own, len(self.time_ns) - len(inside.time_ns) - own


def clean_round(case: Case, loss: Loss) -> tuple[queues.Queue, int, bool]:
    """Return the pipe of a loss, the limit of its MsgId there, and whether the limit was measured."""
    output = loss.hop == telemetry_output.PIPE
    queue = queues.telemetry_pipe(case.profile) if output else queues.peer_pipe(case.profile)
    commanded = command.limit if (command := limit_command(case, loss)) else None
    if loss.stream and loss.span:
        own, rounds = loss.span.rows, case.rounds(loss.stream, loss.span)
        near = abs(rounds.period_ns - queue.round_ns) < queue.round_ns // (10 if output else 5)
        lacking = loss.stream.time_ns[own], loss.stream.missing[own], rounds.most
        lower = commanded is not None and commanded < rounds.most  # for a part of the time
        if near and not lower and rounds.share >= _FULL and full_where_lacking(*lacking):
            return replace(queue, round_ns=rounds.period_ns), rounds.most, True
        # Rounds that are far larger refute an assumed limit; a network that gathers some has gaps within.
        within = int(lacking[1][:-1][np.diff(lacking[0]) < queue.round_ns // 2].sum())
        larger = rounds.share >= _FULL and rounds.most > 2 * queue.limit(loss.msg_id)
        if commanded is None and larger and 2 * within < lacking[1].sum():
            return queue, rounds.most, True
    system = case.instances.system(loss.instance)
    if commanded is None and output and case.timeline.entry(loss.msg_id, system):
        queue = queues.telemetry_pipe(case.assumed)  # what was learned may hold for another time
    return queue, queue.limit(loss.msg_id) if commanded is None else commanded, False


def limit_command(case: Case, loss: Loss) -> Change | None:
    """Return the command that set the limit at Telemetry Output during a loss, a lower one if it changed."""
    if loss.hop != telemetry_output.PIPE:
        return None
    times = loss.among.times_ns if loss.among and len(loss.among.rows) else (loss.start_ns, loss.end_ns)
    changes, again = _entries(case, loss)
    last = next((item for item in reversed(changes) if item.not_before_ns <= times[0] + SECOND), None)
    low = (last.limit if last else 0) or queues.telemetry_pipe(case.profile).limit(loss.msg_id)
    within = [item for item in again if times[0] + SECOND < item.not_before_ns < times[1]]
    lower = [item for item in reversed(within) if (item.limit or low) < low]  # others set none
    return min(lower, key=lambda item: item.limit or low, default=last)


def _entries(case: Case, loss: Loss) -> tuple[Sequence[Change], list[Change]]:
    """Return the changes of a MsgId's entry in the table of Telemetry Output, and those that set a limit."""
    changes = case.timeline.entry(loss.msg_id, case.instances.system(loss.instance))
    # What is added while it is there keeps its limit.
    return changes, [item for old, item in pairwise(changes) if old.state == "unsubscribed"]


def _other_limits(case: Case, losses: Sequence[Loss], worst: Loss) -> str:
    """Return other commanded limits than that of the worst loss, and the losses at them; empty if none."""
    span = worst.start_ns, worst.end_ns
    lost: Counter[Change | None] = Counter()
    for loss in losses:
        lost[limit_command(case, loss)] += loss.lost
    lost.update({item: 0 for item in _entries(case, worst)[1] if span[0] < item.not_before_ns < span[1]})
    del lost[limit_command(case, worst)]
    of_table = [clean_round(case, loss)[1] for loss in losses if not limit_command(case, loss)]
    differs = lost[None] and of_table[0] != clean_round(case, worst)[1]
    before = [f"{of_table[0]} before that: {lost[None]:,} of these"] if differs else []
    later = (
        f"{item.value} from {case.at(item.not_before_ns)} on{f': {number:,} of these' if number else ''}"
        for item, number in lost.items()
        if item and item.limit
    )
    return ", ".join([*before, *later])


def crowding_of(case: Case, loss: Loss) -> str:
    """Return a clause that says who sent the messages more than once; empty if they were sent once."""
    return crowding(case.rows, rows, case.endpoints) if len(rows := _rows_of(loss)) else ""


def _rows_of(loss: Loss) -> Places:
    """Return the rows of a loss' stream in its span; empty if either is unknown."""
    if loss.span is None or loss.stream is None:
        return np.zeros(0, np.intp)
    return loss.stream.rows[loss.span.rows]


def depth_at(case: Case, loss: Loss, queue: queues.Queue) -> int:
    """Return the depth of a pipe: measured if the pipe was full, else the configured one."""
    full = any(item.kind == "overflow" and item.hop == loss.hop for item in case.losses)
    if loss.stream is None or not full:
        return queue.depth
    return min(queue.depth, case.measured_depth(loss.stream.pipe, queue.round_ns))


def _key(loss: Loss) -> tuple[object, ...]:
    return loss.kind, loss.hop, loss.msg_id, loss.instance, loss.stream


def advise(case: Case, loss: Loss) -> Advice:
    """Return the remedy for all losses of a MsgId at a queue; computed once, for the worst of them."""
    return _advice(case, _key(loss))


@keep_results
def _advice(case: Case, key: tuple[object, ...]) -> Advice:
    alike = [item for item in case.losses if _key(item) == key]
    # A remedy for the lowest commanded limit also helps at the other limits.
    commands = ((limit_command(case, item), item) for item in alike)
    lowest = (((command.limit if command else 0) or _MOST, item) for command, item in commands)
    worst = max(lowest, key=lambda pair: (not pair[1].closed, -pair[0], pair[1].lost))[1]
    at_output, still = _at_output(worst), stood_still(case, worst)
    advice = (_at_pipe if at_output else _at_application)(case, worst)
    because = [_other_limits(case, alike, worst) if at_output else crowding_of(case, worst), still]
    if worst.kind == "socket" and worst.stream and case.is_far(worst.stream.receiver):
        because.append("what the network lost before it at that time looks alike")
    advice = replace(advice, why="; ".join([advice.why, *(item for item in because if item)]))
    return replace(advice, remedy=LET_RUN, left=None) if still else advice


def capacity(case: Case, loss: Loss) -> str:
    """Return how much the queue of a loss takes, and whether that was measured, told or assumed."""
    who, origin = "SBN" if loss.over_network else "CI", ""
    names: tuple[str | int, ...]
    if _at_output(loss):
        queue, limit, measured = clean_round(case, loss)
        keeps, names = "TO keeps {} of this MsgId and sends", (loss.msg_id, "to_wake_ns")
        if loss.hop != telemetry_output.PIPE:
            keeps, names = "it keeps {} of this MsgId and SBN empties it", ("sbn_msg_limit", "sbn_wake_ns")
        origin, command = " (measured)" * measured, limit_command(case, loss)
        if command and command.value == limit:
            origin = f" (set by a command at {case.at(command.not_before_ns)})"
    elif loss.kind == "socket":
        queue = queues.ci_socket(case.profile)
        limit, keeps, names = queue.reads, "CI reads {}", ("ci_wake_ns", "ci_datagrams_per_wake")
    else:
        queue, source = case.application_pipe(loss)
        clean = queue.rate_hz(queue.usual_limit)
        if loss.stream is not None and (hz := case.lossless_hz(loss.stream, clean)):
            return f"{hz:.0f} Hz got through here, {loss.offered_hz:.0f} Hz did not (measured)"
        keeps, origin = f"it keeps {{}} of one MsgId, and {who} hands over a burst", f" ({source})"
        limit, names, times = queue.usual_limit, (), case.rows.time_ns[_rows_of(loss)]
        if loss.over_network and not (more_at_once(times, queue.round_ns, limit) or stood_still(case, loss)):
            every = f"{queue.round_ns / MILLISECOND:.0f} ms"
            return f"no more than {limit} came in {every}: its task reads late, or keeps fewer of one MsgId"
    rate = f" every {queue.round_ns / MILLISECOND:.0f} ms: {queue.rate_hz(limit):.0f} a second get through"
    text = keeps.format(limit) + rate if limit else "TO keeps none of this MsgId"
    return text + (origin or f" ({case.origin(*names)})")


def _at_output(loss: Loss) -> bool:
    """Return whether a loss is at the pipe of Telemetry Output or of an SBN peer."""
    return loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN_")


def _at_pipe(case: Case, loss: Loss) -> Advice:
    """Return the remedy where the pipe of Telemetry Output or of an SBN peer takes too few of a MsgId."""
    queue, limit, measured = clean_round(case, loss)
    msg_id, output, why = loss.msg_id, loss.hop == telemetry_output.PIPE, capacity(case, loss)
    rate = queue.rate_hz(limit)
    queue = replace(queue, depth=depth_at(case, loss, queue))
    slower = f"publish at most {_safe(rate):g} Hz"
    if loss.stream is None:
        return Advice(why, slower if limit else _raised(case, msg_id, telemetry_output.USUAL_LIMIT))
    arrivals = published_into(case, loss.stream).around(loss, queue.round_ns)
    own = arrivals.only(msg_id)
    if not limit:
        return Advice(why, _raised(case, msg_id, own.most(queue.round_ns * _LATE) + 1))
    now, fits = queue.with_limit(msg_id, limit), False
    is_event = loss.stream.known_id == EVENT_MSG_ID
    if not is_event and (measured or loss.offered_hz > rate):
        fits = _explains(own.between(loss.start_ns, loss.end_ns).lost((now,), msg_id), loss.lost)
    if is_event:
        slower = _on_console(case, loss)
    elif loss.stream.counted:  # else the arrivals do not contain the lost messages
        slower = _spread(case, own, queue, limit, slower, ("published", "TO" if output else "SBN", 0))
    slow = max(own.spaced(SECOND / _safe(rate), msg_id).lost((now,), msg_id)) if fits else None
    if not output:
        return Advice(why, slower, slow)
    need = min(_MOST, max(own.most(queue.round_ns * _LATE) + 1, limit + 1 if fits else 2 * limit))
    higher = arrivals.lost_of((queue.with_limit(msg_id, need),), msg_id, _PHASES)
    rest, others = max(own for own, _ in higher), sum(other for _, other in higher)
    if rest or others > sum(other for _, other in arrivals.lost_of((now,), msg_id, _PHASES)):
        return Advice(why, slower, slow)
    remedy = f"{slower}, or {_raised(case, msg_id, need)}"
    return Advice(why, remedy, None if slow is None else max(rest, slow))


def _on_console(case: Case, loss: Loss) -> str:
    """Return the remedy for lost events: nobody spreads them, but cFS prints them, too."""
    apps = Counter(item.app for item in case.events_between(loss.start_ns, loss.end_ns))
    who = "".join(f" (most that came are of {app})" for app, _ in apps.most_common(1))
    return f"read them on cFS's console, which prints all{who}"


def _safe(rate_hz: float) -> float:
    """Return a rate that gets through even if rounds are a little late, in Hz, rounded down to 0.1."""
    return math.floor(rate_hz / _LATE * 10) / 10


def _explains(model: list[int], lost: int, waiting: int = 0) -> bool:
    """Return whether a model that ran at several phases explains a loss.

    Args:
        model: losses of the model, one for each phase.
        lost: messages that were lost.
        waiting: further messages that were waiting at the end, or were lost.
    """
    least, most = _FITS
    return any(least * item - _FEW <= lost + waiting and lost <= most * item + _FEW for item in model)


def _spread(
    case: Case, own: Arrivals, queue: queues.Queue, limit: int, slower: str, words: tuple[str, str, int]
) -> str:
    """Return the remedy for a rate: send slower, or spread bursts; or that the reader of the queue was late.

    Args:
        slower: remedy for a sender that is too fast.
        words: what senders did, as a participle; the reader of the queue; and how many more CI counted, if
            these are enough to fill it.
    """
    did, reader, more = words
    most = own.most(queue.round_ns)
    if most <= limit:
        if more:
            return f"see what doubles commands on the way, or who else sends: CI counted {more:,} more"
        return f"see what keeps {reader} from its pipe (its console, the load of its host)"
    while_ns = min(_WHILE_NS, case.end_ns - case.start_ns)
    if own.most(while_ns) * SECOND <= queue.rate_hz(limit) * while_ns:
        every_ms = queue.round_ns // MILLISECOND
        return f"spread what is {did}: at most {limit} in {every_ms} ms (up to {most:,} were)"
    return f"{slower} (up to {own.rate():,} a second were {did})"


def published_into(case: Case, stream: Stream) -> Arrivals:
    """Return the arrivals at the pipe that a stream comes from, including the lost messages."""
    alike = [item for item in case.streams if item.pipe == stream.pipe]
    published = [published_at(case, item) for item in alike]
    time_ns = np.concatenate(published)
    msg_id = np.repeat([item.msg_id for item in alike], [*map(len, published)])
    return Arrivals(time_ns, msg_id).take(np.argsort(time_ns, kind="stable"))


@keep_results
def published_at(case: Case, stream: Stream) -> Integers:
    """Return when each message of a stream was published, including the missing ones, ns: i64 (messages,).

    The times are those of the headers, if all have one; else those of the capture.
    """
    when, mission = stream.time_ns, case.rows.mission_time_ns[stream.rows]
    if stream.instance != NOBODY and (mission > 0).all():
        when = np.maximum.accumulate(mission + case.instances.items[stream.instance].offset_ns)
    counts = stream.counts
    at = np.cumsum(counts) - counts
    place = np.arange(int(counts.sum()))
    times = np.interp(place, at, when.astype(np.float64)).astype(np.int64)
    # Messages missing in a long pause follow at the distance of the messages before the pause: a burst comes
    # at once, a steady stream goes on during the pause.
    pause_ns = np.append(np.diff(when), 0)
    inside = np.repeat((pause_ns > _PAUSE * case.profile.to_wake_ns) & (counts > 1), counts)
    whole = np.flatnonzero(counts[:-1] == 1)
    if len(whole):
        before = sliding_window_view(np.pad(pause_ns[whole], (_STEPS - 1, 0), "edge"), _STEPS)
        # One that comes in rounds is steady, too.
        rounds = before.max(axis=1) <= _PAUSE * case.profile.to_wake_ns
        middle_ns = np.where(rounds, before.mean(axis=1), np.median(before, axis=1)).astype(np.int64)
        usual_ns = np.maximum(pause_ns[whole], middle_ns)
        step_ns = usual_ns[np.maximum(np.searchsorted(whole, np.arange(len(counts))) - 1, 0)]
    else:
        step_ns = case.profile.to_wake_ns // (2 * counts)
    nth = place - np.repeat(at, counts)
    later = np.minimum(nth * np.repeat(step_ns, counts), np.repeat(pause_ns, counts))
    return np.where(inside, np.repeat(when, counts) + later, times)


def _raised(case: Case, msg_id: int, limit: int) -> str:
    """Return how to raise a limit: an entry keeps its limit, so it has to be removed first."""
    remove = case.inject("to-remove", f"0x{msg_id:04x}")
    lasting, add = "in its table (to_lab_sub)", case.add_line(msg_id, limit)
    return f"raise TO's limit for it to {limit}: {lasting}, or until TO restarts with {remove}; {add}"


def _at_application(case: Case, loss: Loss) -> Advice:
    """Return the remedy where an application's pipe takes too few of a command, or CI's socket is full."""
    stream, over_network, socket = loss.stream, loss.over_network, queues.ci_socket(case.profile)
    pipe, _ = case.application_pipe(loss)
    limit, clean, why = pipe.usual_limit, pipe.rate_hz(pipe.usual_limit), capacity(case, loss)
    if stream is None:
        return Advice(why, f"send at most {_safe(clean):g} Hz, or {_subscribed('a higher limit')}")
    if loss.kind != "socket" and (hz := case.lossless_hz(stream, clean)):
        return Advice(why, f"send at most {_safe(hz):g} Hz, evenly")
    rows = np.flatnonzero((case.rows.link == stream.link) & (case.rows.destination == stream.receiver))
    arrivals = Arrivals(case.rows.time_ns[rows], case.rows.msg_id[rows].astype(np.int64))
    arrivals = arrivals.around(loss, pipe.round_ns)
    own, way = arrivals.only(stream.msg_id), (pipe,) if over_network else (socket, pipe)
    at_limit, in_socket = (_meanwhile(case, loss, kind) for kind in ("limit", "socket"))
    ingests = case.ingests_at(stream.receiver)
    waiting, more = sum(item.waiting for item in ingests), sum(item.not_captured for item in ingests)
    number = at_limit + in_socket or loss.lost
    model = arrivals.between(loss.start_ns, loss.end_ns).lost(way, stream.msg_id)
    fits = _explains(model, number, waiting)
    why = f"{why[:-1]}, and fits what was lost)" if fits else why
    slow = number > _FITS[1] * max(model) + _FEW and _reads_late(case, loss)
    senders = len(senders_at_once(case.rows, _rows_of(loss)))
    slower = f"send at most {_safe(clean):g} Hz"
    if senders > 1:
        slower += f" in all, {_safe(clean / senders):g} Hz each of {plural(senders, 'sender')}"
    at_once = arrivals.most(pipe.round_ns)
    crowds = at_once > socket.reads and own.most(pipe.round_ns) <= limit and not over_network
    if crowds:
        every = f"every {pipe.round_ns // MILLISECOND} ms"
        reads = f"it reads {socket.reads} {every} (up to {at_once} were), and the rest comes late"
        most = int(np.bincount(case.rows.source[rows]).argmax())
        by = f", most of it by {case.endpoints[most]}" * (most != stream.sender)
        slower = f"spread all that is sent to CI{by}: {reads}"
    else:
        at = limit if not slow else len(rows)  # read later than the model does: no rate helps alone
        words = "sent", "the application's task", more * (more >= number)  # fewer do not fill the pipe
        slower = _spread(case, own, pipe, at, slower, words)
    need = min(own.most(pipe.round_ns * _LATE) + 1, pipe.depth if over_network else socket.reads)
    higher = (*way[:-1], pipe.with_limit(stream.msg_id, need))
    if need > limit and not (slow or in_socket or max(arrivals.lost(higher, stream.msg_id))):
        slower += f", or {_subscribed(f'a limit of {need:,}')}"
    paced = arrivals.spaced(SECOND / _safe(clean), stream.msg_id)
    if loss.kind == "socket" and not crowds and len(own.time_ns) < _MOSTLY * len(arrivals.time_ns):
        all_hz = _safe(socket.rate_hz(socket.reads))
        slower = f"send CI at most {all_hz:g} Hz in all, {_safe(clean):g} Hz of each MsgId"
        return Advice(why, f"{slower} (up to {arrivals.rate():,} a second were sent)")
    return Advice(why, slower, max(paced.lost(way, stream.msg_id)) if fits else None)


def _reads_late(case: Case, loss: Loss) -> bool:
    """Return whether a loss beyond the assumed limit cannot be due to a lower one.

    A lower limit shows in the rounds at the robot, and loses some in most rounds.
    """
    at_robot = any(hop.into is loss.stream and hop.out.link.last_hop for hop in case.hops)
    if at_robot or loss.kind == "socket" or (track := case.tracks.get(loss.instance)) is None:
        return at_robot and loss.kind != "socket"
    times, grown = np.array(track.times), np.diff(track.totals["msg_limits"])
    grown = grown[(times[:-1] >= loss.start_ns) & (times[1:] <= loss.end_ns)]
    return bool(2 * np.count_nonzero(grown) < len(grown))


def _meanwhile(case: Case, loss: Loss, kind: str) -> int:
    """Return how many messages the stream of a loss lost during it in one way."""
    others = case.losses_of(loss.stream) if loss.stream else []
    near = (item for item in others if item.start_ns < loss.end_ns and loss.start_ns < item.end_ns)
    return sum(item.lost for item in near if item.kind == kind)


def _subscribed(limit: str) -> str:
    return f"let the application subscribe with {limit} (CFE_SB_SubscribeEx)"


def stood_still(case: Case, loss: Loss) -> str:
    """Return the sentence that a whole cFS stood still, and most of a loss came after that; else empty."""
    if not (stalls := list(_stalls_of(case, loss))):
        return ""
    first = f"from {case.at(stalls[0].start_lo)} to {case.at(stalls[0].end_hi)}"
    when = f"{len(stalls)} times, first {first}" if len(stalls) > 1 else first
    return f"{case.label(loss.instance)} stood still {when}, and what had waited came at once"


def _stalls_of(case: Case, loss: Loss) -> Iterator[StateSpan]:
    """Yield the times in which the cFS of a loss stood still, if most of the loss came then or just after."""
    spans = case.timeline.spans(StateOwner("cfs"), "stalled", case.instances.system(loss.instance))
    if loss.among is None or (loss.among.missing is None and len(loss.among.rows) > 2 * loss.lost):
        # The lost messages are not identified: all overlapping times count.
        yield from (span for span in spans if span.overlaps(loss.start_ns - TAIL_NS, loss.end_ns))
        return
    when = loss.among.stream.time_ns[loss.among.rows]
    number = np.ones(len(when), np.int64) if loss.among.missing is None else loss.among.missing
    near = [(span, (when > span.start_lo - SECOND) & (when < span.end_hi + SECOND)) for span in spans]
    if sum(int(number[inside].sum()) for _, inside in near) * 2 > int(number.sum()):
        yield from (span for span, inside in near if inside.any())
