"""What to change where a queue loses messages, what would still be lost then, and the verdict on a loss.

Rules:

1. Arrivals are those of the capture. What was published and lost came between its neighbours, evenly.
2. When a queue is read is known to a round, not to the millisecond: the model is asked at several phases,
   and what it says of the worst is told.
3. Before the model promises anything it has to explain what was lost. It may lose up to twice as many: there
   no reader takes a message while a burst still comes in.
4. A limit is raised only where that costs nobody else a message.
"""

from __future__ import annotations

import math
from collections import Counter
from ipaddress import ip_address
from itertools import pairwise
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.lib.stride_tricks import sliding_window_view

from edoras_tools.cfs import queues, telemetry_output
from edoras_tools.diagnosis.accounting.losses import COUNTERS, TAIL_NS, Loss
from edoras_tools.diagnosis.accounting.pipes import measured_depth
from edoras_tools.diagnosis.evidence.copies import crowding, senders_at_once
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import Change, StateOwner, StateSpan
from edoras_tools.diagnosis.matching.streams import Stream, full_where_lacking
from edoras_tools.diagnosis.verdict import Advice, Verdict, error
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.wire.arrays.order import Integers, Mask, Places


LET_RUN: Final = "look at the load of its host, and at who may stop its process (a debugger, SIGSTOP)"
"""What helps where a whole cFS stood still: no rate and no limit does."""
_PHASES: Final = 4
_ROUNDS: Final = 1000
"""The model goes through so many rounds before and behind the middle of the worst loss."""
_FULL: Final = 0.3
"""Rounds of which so many are full show how many may wait."""
_LATE: Final = 1.01
"""A round may be so much longer than it should be."""
_FITS: Final = 0.5, 1.2
_FEW: Final = 5
"""What was lost is explained by a model if it is between these shares of what the model loses, or so near."""
_STEPS: Final = 5
"""So many steps between messages show how close together the next ones came."""
_PAUSE: Final = 2
"""A pause is longer than so many rounds."""
_MOST: Final = 255
"""Telemetry Output's table takes no higher limit."""
_WHILE_NS: Final = 10 * SECOND
"""Who sends no more than gets through in so long, but too many at once, sends bursts."""


class Arrivals(NamedTuple):
    """What arrives at a queue, in order of time.

    Attributes:
        time_ns: (n,), i64, ns.
        msg_id: (n,), i64.
    """

    time_ns: Integers
    msg_id: Integers

    def take(self, rows: Places | Mask) -> Arrivals:
        """Return some of them."""
        return Arrivals(self.time_ns[rows], self.msg_id[rows])

    def only(self, msg_id: int) -> Arrivals:
        """Return those of a MsgId."""
        return self.take(self.msg_id == msg_id)

    def between(self, start_ns: int, end_ns: int) -> Arrivals:
        """Return those of a span of time."""
        first, last = np.searchsorted(self.time_ns, (start_ns, end_ns + 1))
        return Arrivals(self.time_ns[first:last], self.msg_id[first:last])

    def around(self, loss: Loss, round_ns: int) -> Arrivals:
        """Return those of the rounds that the model goes through."""
        middle_ns, margin_ns = (loss.start_ns + loss.end_ns) // 2, _ROUNDS * round_ns
        return self.between(middle_ns - margin_ns, middle_ns + margin_ns)

    def spaced(self, gap_ns: float, msg_id: int) -> Arrivals:
        """Return the same with so much time between two of a MsgId: each as early as that lets it."""
        own = self.msg_id == msg_id
        steps = (np.arange(int(own.sum())) * gap_ns).astype(np.int64)
        time_ns = self.time_ns.copy()
        time_ns[own] = np.maximum.accumulate(time_ns[own] - steps) + steps
        return Arrivals(time_ns, self.msg_id).take(np.argsort(time_ns, kind="stable"))

    def most(self, window_ns: float) -> int:
        """Return the most that arrive within a window of time."""
        last = np.searchsorted(self.time_ns, self.time_ns + int(window_ns))
        return int((last - np.arange(len(last))).max(initial=0))

    def rate(self) -> int:
        """Return the most that arrive in a second; steady ones that come a little early do not add one."""
        step_ns = np.median(np.diff(self.time_ns)) if len(self.time_ns) > 1 else 0
        return self.most(SECOND - step_ns / 2)

    def lost(self, way: tuple[queues.Queue, ...], msg_id: int, phases: int = _PHASES) -> list[int]:
        """Return how many of a MsgId a way through queues loses, at each of several phases."""
        return [own for own, _ in self.lost_of(way, msg_id, phases)]

    def lost_of(
        self, way: tuple[queues.Queue, ...], msg_id: int, phases: int = _PHASES
    ) -> list[tuple[int, int]]:
        """Return how many of a MsgId, and how many others, a way loses, at each of several phases."""
        return [self._lost(way, msg_id, at * way[-1].round_ns // phases) for at in range(phases)]

    def _lost(self, way: tuple[queues.Queue, ...], msg_id: int, phase_ns: int) -> tuple[int, int]:
        inside = self
        for queue in way:
            kinds = np.zeros_like(inside.msg_id) if queue.is_socket else inside.msg_id
            passed = queues.pass_queue(replace(queue, phase_ns=phase_ns), inside.time_ns, kinds)
            out = passed.delivered
            inside = Arrivals(passed.left_ns[out], inside.msg_id[out])
        own = int((self.msg_id == msg_id).sum() - (inside.msg_id == msg_id).sum())
        return own, len(self.time_ns) - len(inside.time_ns) - own


def clean_round(case: Case, loss: Loss) -> tuple[queues.Queue, int, bool]:
    """Return the pipe of a loss, how many of its MsgId may wait there, and whether that was measured."""
    output = loss.hop == telemetry_output.PIPE
    queue = queues.telemetry_pipe(case.profile) if output else queues.peer_pipe(case.profile)
    commanded = _limit_of(limit_command(case, loss))
    if loss.stream and loss.span:
        own, rounds = loss.span.rows, case.rounds(loss.stream, loss.span)
        near = abs(rounds.period_ns - queue.round_ns) < queue.round_ns // (10 if output else 5)
        lacking = loss.stream.time_ns[own], loss.stream.missing[own], rounds.most
        lower = commanded is not None and commanded < rounds.most  # for a part of the time
        if near and not lower and rounds.share >= _FULL and full_where_lacking(*lacking):
            return replace(queue, round_ns=rounds.period_ns), rounds.most, True
    return queue, queue.limit(loss.msg_id) if commanded is None else commanded, False


def limit_command(case: Case, loss: Loss) -> Change | None:
    """Return the command that set how few of a MsgId may wait at Telemetry Output while some were lost."""
    if loss.hop != telemetry_output.PIPE:
        return None
    times = loss.among.times_ns if loss.among and len(loss.among.rows) else (loss.start_ns, loss.end_ns)
    changes = _entry_commands(case, loss.instance, loss.msg_id)
    last = next((item for item in reversed(changes) if item.not_before_ns <= times[0] + SECOND), None)
    low = _limit_of(last) or queues.telemetry_pipe(case.profile).limit(loss.msg_id)
    again = [item for old, item in pairwise(changes) if old.state == "unsubscribed"]  # else its limit stays
    within = [item for item in again if times[0] + SECOND < item.not_before_ns < times[1]]
    lower = [item for item in reversed(within) if (_limit_of(item) or 0) < low]
    return min(lower, key=lambda item: _limit_of(item) or 0, default=last)


def set_by(case: Case, loss: Loss, limit: int) -> str:
    """Return when a command set the limit at which some were lost, in brackets; empty where none did."""
    command = limit_command(case, loss)
    if command is None or command.value != limit:
        return ""
    return f" (set by a command at {case.at(command.not_before_ns)})"


def _other_limits(case: Case, losses: Iterable[Loss], worst: Loss) -> str:
    """Return how many were lost at other limits than the worst, which commands set; empty where none were."""
    lost: Counter[Change | None] = Counter()
    for loss in losses:
        lost[limit_command(case, loss)] += loss.lost
    del lost[limit_command(case, worst)]
    return ", ".join(
        f"{number:,} of these when it kept {item.value}, set at {case.at(item.not_before_ns)}"
        for item, number in lost.items()
        if item and _limit_of(item)
    )


def told_limit(case: Case, stream: Stream) -> int | None:
    """Return how many messages of a stream may wait at Telemetry Output, if the last command says so."""
    if not stream.link.only_from_cfs:
        return None
    return _limit_of(next(reversed(_entry_commands(case, case.owner(stream), stream.msg_id)), None))


def _limit_of(command: Change | None) -> int | None:
    return command.value if command and isinstance(command.value, int) else None


def _entry_commands(case: Case, instance: int, msg_id: int) -> list[Change]:
    """Return the commands about an entry of Telemetry Output's table, in order of time."""
    return list(case.timeline.of(StateOwner("entry", "", msg_id), case.instances.system(instance)))


def crowding_of(case: Case, loss: Loss) -> str:
    """Return who sent what was lost more than once, in half a sentence; empty where nobody did."""
    return crowding(case.rows, rows, case.endpoints) if len(rows := _rows_of(loss)) else ""


def _rows_of(loss: Loss) -> Places:
    """Return the rows of the traffic that a loss is of, in its time."""
    if loss.span is None or loss.stream is None:
        return np.zeros(0, np.intp)
    return loss.stream.rows[loss.span.rows]


def _depth(case: Case, loss: Loss, queue: queues.Queue) -> int:
    """Return how deep a pipe is, where one that was full shows it."""
    full = any(item.kind == "overflow" and item.hop == loss.hop for item in case.losses)
    if loss.stream is None or not full:
        return queue.depth
    own = (case.rows.link == loss.stream.link) & (case.rows.source == loss.stream.sender)
    return min(queue.depth, measured_depth(case.rows.time_ns[own], queue.round_ns))


def _key(loss: Loss) -> tuple[object, ...]:
    return loss.kind, loss.hop, loss.msg_id, loss.instance, loss.stream


def _is_far(case: Case, endpoint: int) -> bool:
    """Tell whether a network may lie between the capture and an endpoint, of which it does not tell."""
    counted = any(item.by_kernel for item in case.ingests_at(endpoint))
    return not (counted or case.capture.shared or ip_address(case.endpoints[endpoint].address).is_loopback)


def advise(case: Case, loss: Loss) -> Advice:
    """Return what helps against all losses of a MsgId at a queue, worked out once, for the worst of them."""
    if (key := _key(loss)) not in case.advice:
        alike = [item for item in case.losses if _key(item) == key]
        at_output = loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN_")
        # What holds at the lowest limit that a command set holds at all.
        worst = max(alike, key=lambda item: (-(_limit_of(limit_command(case, item)) or _MOST), item.lost))
        advice = (_at_pipe if at_output else _at_application)(case, worst)
        still = stood_still(case, worst)
        because = [_other_limits(case, alike, worst) if at_output else crowding_of(case, worst), still]
        if loss.kind == "socket" and loss.stream and _is_far(case, loss.stream.receiver):
            because.append("what the network lost before it at that time looks alike")
        advice = replace(advice, why="; ".join([advice.why, *(item for item in because if item)]))
        case.advice[key] = replace(advice, remedy=LET_RUN, left=None) if still else advice
    return case.advice[key]


def _at_pipe(case: Case, loss: Loss) -> Advice:
    """Return what helps where the pipe of Telemetry Output or of an SBN peer takes too few of a MsgId."""
    queue, limit, measured = clean_round(case, loss)
    msg_id, output = loss.msg_id, loss.hop == telemetry_output.PIPE
    rate, every = queue.rate_hz(limit), f"{queue.round_ns / MILLISECOND:.0f} ms"
    why = f"{'TO keeps' if output else 'it keeps'} {limit} of this MsgId and "
    why += f"{'sends' if output else 'SBN empties it'} every {every}: {rate:.0f} a second get through"
    names = (loss.msg_id, "to_wake_ns") if output else ("sbn_msg_limit", "sbn_wake_ns")
    why += set_by(case, loss, limit) or f" ({'measured' if measured else case.origin(*names)})"
    queue = replace(queue, depth=_depth(case, loss, queue))
    slower = f"publish at most {_safe(rate):g} Hz"
    if loss.stream is None:
        return Advice(why, slower if limit else _raised(case, msg_id, telemetry_output.USUAL_LIMIT))
    arrivals = published_into(case, loss.stream).around(loss, queue.round_ns)
    own = arrivals.only(msg_id)
    if not limit:
        return Advice(why, _raised(case, msg_id, own.most(queue.round_ns * _LATE) + 1))
    now, fits = queue.with_limit(msg_id, limit), False
    if measured or loss.offered_hz > rate:
        fits = _explains(own.between(loss.start_ns, loss.end_ns).lost((now,), msg_id), loss.lost)
    if loss.stream.counted:  # else what was lost is not among them
        slower = _spread(case, own, queue, limit, slower, ("published", "TO" if output else "SBN"))
    slow = max(own.spaced(SECOND / _safe(rate), msg_id).lost((now,), msg_id)) if fits else None
    if not output:
        return Advice(why, slower, slow)
    need = min(_MOST, max(own.most(queue.round_ns * _LATE) + 1, limit + 1 if fits else 2 * limit))
    higher = arrivals.lost_of((queue.with_limit(msg_id, need),), msg_id)
    rest, others = max(own for own, _ in higher), sum(other for _, other in higher)
    if rest or others > sum(other for _, other in arrivals.lost_of((now,), msg_id)):
        return Advice(why, slower, slow)
    remedy = f"{slower}, or {_raised(case, msg_id, need)}"
    return Advice(why, remedy, None if slow is None else max(rest, slow))


def _safe(rate_hz: float) -> float:
    """Return a rate that gets through even where rounds are a little late, in tenths of Hz."""
    return math.floor(rate_hz / _LATE * 10) / 10


def _explains(model: list[int], lost: int, waiting: int = 0) -> bool:
    """Tell whether a model, asked at several phases, explains what was lost.

    Args:
        waiting: how many more wait at the end, or were lost.
    """
    least, most = _FITS
    return any(least * item - _FEW <= lost + waiting and lost <= most * item + _FEW for item in model)


def _spread(
    case: Case, own: Arrivals, queue: queues.Queue, limit: int, slower: str, words: tuple[str, str]
) -> str:
    """Return how to send: slower, or spread out; or that whoever reads the queue was late.

    Args:
        slower: what helps who sends too fast.
        words: what senders did, and who reads.
    """
    did, reader = words
    most = own.most(queue.round_ns)
    if most <= limit:
        return f"see what keeps {reader} from its pipe (its console, the load of its host)"
    while_ns = min(_WHILE_NS, case.end_ns - case.start_ns)
    if own.most(while_ns) * SECOND <= queue.rate_hz(limit) * while_ns:
        every_ms = queue.round_ns // MILLISECOND
        return f"spread what is {did}: at most {limit} in {every_ms} ms (up to {most:,} were)"
    return f"{slower} (up to {own.rate():,} a second were {did})"


def published_into(case: Case, stream: Stream) -> Arrivals:
    """Return all that went into the pipe that a stream came out of, with what was lost of it."""
    alike = [
        (item.msg_id, published_at(case, item))
        for item in case.streams
        if (item.link, item.sender) == (stream.link, stream.sender)
        and (stream.link.only_from_cfs or item.receiver == stream.receiver)
    ]
    time_ns = np.concatenate([times for _, times in alike])
    msg_id = np.concatenate([np.full(len(times), number, np.int64) for number, times in alike])
    return Arrivals(time_ns, msg_id).take(np.argsort(time_ns, kind="stable"))


def published_at(case: Case, stream: Stream) -> Integers:
    """Return when each message of a stream was published, the missing ones too: by its header's time."""
    when, mission = stream.time_ns, case.rows.mission_time_ns[stream.rows]
    if stream.instance != NOBODY and (mission > 0).all():
        when = np.maximum.accumulate(mission + case.instances.items[stream.instance].offset_ns)
    counts = stream.counts
    at = np.cumsum(counts) - counts
    place = np.arange(int(counts.sum()))
    times = np.interp(place, at, when.astype(np.float64)).astype(np.int64)
    # What is missing in a long pause came as close together as what came before it: a burst at once, a steady
    # stream over the pause, as while nothing was to be sent.
    pause_ns = np.append(np.diff(when), 0)
    inside = np.repeat((pause_ns > _PAUSE * case.profile.to_wake_ns) & (counts > 1), counts)
    if not inside.any():
        return times
    whole = np.flatnonzero(counts[:-1] == 1)
    if len(whole):
        before = sliding_window_view(np.pad(pause_ns[whole], (_STEPS - 1, 0), "edge"), _STEPS)
        usual_ns = np.maximum(pause_ns[whole], np.median(before, axis=1).astype(np.int64))
        step_ns = usual_ns[np.maximum(np.searchsorted(whole, np.arange(len(counts))) - 1, 0)]
    else:
        step_ns = case.profile.to_wake_ns // (2 * counts)
    nth = place - np.repeat(at, counts)
    later = np.minimum(nth * np.repeat(step_ns, counts), np.repeat(pause_ns, counts))
    return np.where(inside, np.repeat(when, counts) + later, times)


def _raised(case: Case, msg_id: int, limit: int) -> str:
    """Return how more of a MsgId may wait: one that is in the table already keeps its limit."""
    remove = case.inject("to-remove", f"0x{msg_id:04x}")
    add = case.inject("to-add", f"0x{msg_id:04x}", "--limit", str(limit))
    lasting = "in its table (to_lab_sub)"
    return f"raise TO's limit for it to {limit}: {lasting}, or until TO restarts with {remove}; {add}"


def _at_application(case: Case, loss: Loss) -> Advice:
    """Return what helps where an application's pipe takes too few of a command, or CI's socket is full."""
    over_network = loss.over_network
    pipe = queues.application_pipe(case.profile, over_network=over_network)
    socket = queues.ci_socket(case.profile)
    limit, clean = pipe.usual_limit, pipe.rate_hz(pipe.usual_limit)
    every, who = f"every {pipe.round_ns // MILLISECOND} ms", "SBN" if over_network else "CI"
    names = ("sbn_wake_ns" if over_network else "ci_wake_ns", "app_msg_limit")
    if loss.kind == "socket":
        names = ("ci_wake_ns", "ci_datagrams_per_wake")
        why = f"CI reads {socket.reads} {every}, {socket.rate_hz(socket.reads):.0f} a second of all"
    else:
        why = f"it keeps {limit} of one MsgId, and {who} hands over a burst {every}"
    if loss.stream is None:
        return Advice(
            f"{why} ({case.origin(*names)})",
            f"send at most {_safe(clean):g} Hz, or {_subscribed('a higher limit')}",
        )
    stream = loss.stream
    if loss.kind != "socket" and (hz := case.shown_hz(stream, clean)):
        return Advice(
            f"{hz:.0f} Hz got through here, {loss.offered_hz:.0f} Hz did not (measured)",
            f"send at most {_safe(hz):g} Hz, evenly",
        )
    rows = np.flatnonzero((case.rows.link == stream.link) & (case.rows.destination == stream.receiver))
    arrivals = Arrivals(case.rows.time_ns[rows], case.rows.msg_id[rows].astype(np.int64))
    arrivals = arrivals.around(loss, pipe.round_ns)
    own, way = arrivals.only(stream.msg_id), (pipe,) if over_network else (socket, pipe)
    lost = sum(
        item.lost
        for item in case.losses_of(stream)
        if item.kind in {"limit", "socket"} and item.start_ns < loss.end_ns and loss.start_ns < item.end_ns
    )
    waiting = sum(item.waiting for item in case.ingests_at(stream.receiver))
    fits = _explains(
        arrivals.between(loss.start_ns, loss.end_ns).lost(way, stream.msg_id), lost or loss.lost, waiting
    )
    why += f" ({case.origin(*names)}{', and fits what was lost' if fits else ''})"
    senders = len(senders_at_once(case.rows, _rows_of(loss)))
    slower = f"send at most {_safe(clean):g} Hz"
    if senders > 1:
        slower += f" in all, {_safe(clean / senders):g} Hz each of {plural(senders, 'sender')}"
    at_once = arrivals.most(pipe.round_ns)
    if at_once > socket.reads and own.most(pipe.round_ns) <= limit and not over_network:
        reads = f"it reads {socket.reads} {every} (up to {at_once} were), and the rest comes late"
        slower = f"spread all that is sent to CI: {reads}"
    else:
        slower = _spread(case, own, pipe, limit, slower, ("sent", "the application's task"))
    need = min(own.most(pipe.round_ns * _LATE) + 1, pipe.depth if over_network else socket.reads)
    higher = (*way[:-1], pipe.with_limit(stream.msg_id, need))
    if need > limit and not max(arrivals.lost(higher, stream.msg_id)):
        slower += f", or {_subscribed(f'a limit of {need:,}')}"
    paced = arrivals.spaced(SECOND / _safe(clean), stream.msg_id)
    return Advice(why, slower, max(paced.lost(way, stream.msg_id)) if fits else None)


def _subscribed(limit: str) -> str:
    return f"let the application subscribe with {limit} (CFE_SB_SubscribeEx)"


def lost_at(case: Case, loss: Loss, noun: str = "messages") -> str:
    """Return the start of the sentence: ``12 of 60 messages on 0x0827 (/pose) lost at TO_LAB_TLM_PIPE``."""
    of = f" of {loss.of:,}" if loss.of else ""
    word = noun.removesuffix("s") if loss.lost == 1 and not of else noun
    return f"{loss.lost:,}{of} {word} on {case.name(loss.msg_id)} lost at {loss.hop}"


def published(loss: Loss) -> str:
    """Return ``published at 20/s, ``; nothing where the rate is not known."""
    return f"published at {loss.offered_hz:.0f}/s, " if loss.offered_hz else ""


def stood_still(case: Case, loss: Loss) -> str:
    """Return that a whole cFS stood still and most of a loss came after it; empty where it did not."""
    if not (stalls := list(_stalls_of(case, loss))):
        return ""
    first = f"from {case.at(stalls[0].start_lo)} to {case.at(stalls[0].end_hi)}"
    when = f"{len(stalls)} times, first {first}" if len(stalls) > 1 else first
    return f"{case.label(loss.instance)} stood still {when}, and what had waited came at once"


def _stalls_of(case: Case, loss: Loss) -> Iterator[StateSpan]:
    """Yield when the cFS of a loss stood still, if most of the loss came then or at once after it."""
    spans = case.timeline.spans(StateOwner("cfs"), "stalled", case.instances.system(loss.instance))
    if loss.among is None or (loss.among.missing is None and len(loss.among.rows) > 2 * loss.lost):
        # It is not known which they are.
        yield from (span for span in spans if span.overlaps(loss.start_ns - TAIL_NS, loss.end_ns))
        return
    when = loss.among.stream.time_ns[loss.among.rows]
    number = np.ones(len(when), np.int64) if loss.among.missing is None else loss.among.missing
    near = [(span, (when > span.start_lo - SECOND) & (when < span.end_hi + SECOND)) for span in spans]
    if sum(int(number[inside].sum()) for _, inside in near) * 2 > int(number.sum()):
        yield from (span for span, inside in near if inside.any())


def loss_verdict(
    case: Case,
    loss: Loss,
    reason: str,
    *,
    link: str | None,
    remedy: str | Advice,
    evidence: Iterable[str] | None = None,
) -> Verdict:
    """Return the verdict on a loss, an error.

    Args:
        link: label of the link that it concerns.
        remedy: what to change.
        evidence: what was seen, in place of the loss' own lines.
    """
    still = stood_still(case, loss) if loss.kind in COUNTERS else ""
    return error(
        f"{reason}. {still}" if still else reason,
        *(loss.evidence if evidence is None else evidence),
        *case.drops_text(),
        msg_id=loss.msg_id,
        link=link,
        hop=loss.hop,
        lost=loss.lost,
        of=loss.of,
        span=(loss.start_ns, loss.end_ns),
        remedy=remedy.remedy if isinstance(remedy, Advice) else remedy,
        advice=remedy if isinstance(remedy, Advice) else None,
        confidence=loss.confidence,
        cause=loss.kind,
    )
