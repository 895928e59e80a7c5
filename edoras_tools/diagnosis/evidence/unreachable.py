"""Finds datagrams that reached nobody, and the times in which ports were closed, from ICMP errors.

Rules:

1. The datagram that an error quotes is lost. It is found by endpoints and IP identification: the last one
   before the error that no other error quotes.
2. A port is closed from the first error that its own host sends until the next sign of life. A sign of life
   is two datagrams in succession to it without an error, or a datagram from it, unless the next one to it
   has an error. One datagram without an error is not enough: its error may be lost. A datagram from the port
   with an error behind it is not enough either: a connected socket sends, but hears only its peer.
3. A host limits its errors: Linux sends six at once and then one a second to each receiver, except on
   loopback. So a datagram without an error shows an open port only if the host would have sent one. The other
   datagrams are lost between two errors, and uncertain after the last error.
4. A program may have ended before it read the datagrams just before the first error. If the port sends
   regularly, these are uncertain, from its last own datagram on.
5. An error from another host, or of another kind, proves only the datagram that it quotes lost. Those just
   behind are uncertain: the host limits these errors, too. Errors about lengths concern no shorter ones.
6. A robot that sends regularly, falls silent, and whose host sends no error, may be off: what goes to it
   until it sends again is uncertain. The capture may leave errors out, and a host that is off sends none.
   If single datagrams of it are missing, as on a network that loses some, chance may take more in a row.
"""

from __future__ import annotations

import ipaddress
from math import log
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.evidence.fingerprint import brackets
from edoras_tools.diagnosis.evidence.table import Rows, number_hosts
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.links.icmp import NOT_JOINED, TOO_LONG
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays import Integers, Mask, Places, by_value, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.decode.conversations import Flow
    from edoras_tools.diagnosis.evidence.port_errors import ErrorRecorder, PortErrors
    from edoras_tools.model import Endpoint

_WITHIN_NS: Final = 5 * SECOND
"""Longest time from a datagram to its error."""
_JOIN_NS: Final = 65 * SECOND
"""The same if the receiver waited for fragments: Linux waits 30 s, others 60 s (RFC 1122 3.3.2)."""
_DISORDER_NS: Final = 50 * MILLISECOND
"""An error may stand this long before its datagram in the capture, if the identification is known."""
_PATIENCE_NS: Final = 1200 * MILLISECOND
"""After this time a host that limits its errors sends another one."""
_UNREAD_NS: Final = 600 * MILLISECOND
"""Longest time that a datagram waits in a socket: programs wake up at once, or twice a second."""
_BURST: Final = 7
"""A host that limits its errors sends fewer within a second."""
_DATAGRAM, _ERROR, _VOICE = range(3)
_VOICES: Final = 3
_REGULAR: Final = 2
"""A port sends regularly if it sent ``_VOICES`` datagrams, and paused for at most this many usual steps."""
_SILENT: Final = 2.2
"""A robot is silent if it sends nothing for so many usual steps: more than one that the capture missed."""
_CHANCE: Final = 0.001
_OFTEN: Final = 3
"""A robot that pauses for as long more often than this is not off."""
_SELDOM: Final = 0.2
"""A robot whose steps are so long more often sends irregularly."""


class ClosedSpan(NamedTuple):
    """A time in which a port was closed.

    Attributes:
        port: endpoint of the port.
        start_ns: time of the datagram that the first error quotes.
        last_ns: time of the datagram that the last error quotes.
        end_ns: time of the next sign of life; ``NEVER`` without one.
        errors: number of errors; 0 of a robot that only fell silent.
        step_ns: mean time between two datagrams from the port before it fell silent; 0 if it did not.
    """

    port: Endpoint
    start_ns: int
    last_ns: int
    end_ns: int
    errors: int
    step_ns: int = 0


class Unreachable:
    """The datagrams of a capture that reached nobody.

    Args:
        rows: table of datagrams, in order of time.
        recorder: recorder of the errors.
        endpoints: endpoints that ``source`` and ``destination`` of the rows index.
        translated: address to its other name on the inner side of an address translation.

    Attributes:
        closed: bool (rows,), the datagram went to a closed port.
        refused: i64 (rows,), the reason that another error gives that quotes it; 0 without one.
        uncertain: bool (rows,), it perhaps went to a closed port, or was not read there.
        spans: times in which ports were closed, by port and time.
    """

    def __init__(
        self,
        rows: Rows,
        recorder: ErrorRecorder,
        endpoints: Sequence[Endpoint],
        translated: Mapping[str, str],
    ) -> None:
        self.closed, self.uncertain = np.zeros((2, len(rows)), bool)
        self.refused = np.zeros(len(rows), np.int64)
        self.spans: list[ClosedSpan] = []
        errors = recorder.errors()
        if not len(errors.print) or not len(rows):
            return
        number = {endpoint: at for at, endpoint in enumerate(endpoints)}
        same = [replace(item, address=translated.get(item.address, item.address)) for item in endpoints]
        names = np.array([number.get(item, at) for at, item in enumerate(same)])
        errors = errors._replace(source=names[errors.source], destination=names[errors.destination])
        row = _quoted(rows, errors)
        others = (row >= 0) & ~errors.closed
        self.refused[row[others]] = errors.reason[others]
        self._doubt_behind(rows, row[others], errors.time_ns[others])
        closing, own = errors.take(errors.closed), row[errors.closed]
        self.closed[own[own >= 0]] = True
        times, sources = recorder.voices()[:2]
        self._close(_events(rows, closing, own, self.closed, (times, names[sources])), endpoints)
        self.refused[self.closed] = 0
        self.uncertain[self.closed | (self.refused > 0)] = False

    def _doubt_behind(self, rows: Rows, quoted: Places, errors_ns: Integers) -> None:
        """Mark as uncertain what follows a refused datagram sooner than its host sends errors (rule 5).

        Args:
            quoted: rows of the refused datagrams.
            errors_ns: i64, capture time of the error about each.
        """
        ways, refused, delay_ns = rows.way(), self.refused > 0, np.zeros(len(rows), np.int64)
        delay_ns[quoted] = errors_ns - rows.time_ns[quoted]
        end_ns = max(int(rows.time_ns[-1]), int(errors_ns.max(initial=0)))
        for _, own in groups(ways, np.flatnonzero(np.isin(ways, ways[refused]))):
            answered, times, length = refused[own], rows.time_ns[own], rows.length[own]
            behind, last_ns = (np.maximum.accumulate(x) for x in (answered, np.where(answered, times, 0)))
            by_length = np.isin(self.refused[own[answered]], NOT_JOINED + TOO_LONG).all()
            least = length[answered].min() if by_length else 0
            # The errors about the last ones may have been due after the end of the capture.
            due_ns = times + delay_ns[own].max() - _DISORDER_NS
            late = (times - last_ns < _PATIENCE_NS) | (due_ns > end_ns)
            self.uncertain[own] |= behind & late & (length >= least)

    def _close(self, events: _Events, endpoints: Sequence[Endpoint]) -> None:
        """Add the times in which ports were closed, and mark the datagrams of rules 3 and 4."""
        port, times, row = events[:3]
        voice, error = np.flatnonzero(events.kind == _VOICE), events.kind == _ERROR
        telling = _telling(events, endpoints)
        fresh = np.append(True, port[1:] != port[:-1])
        bounds = np.append(np.flatnonzero(_signs_of_life(events, telling) | fresh), len(port))
        for place in np.flatnonzero(np.add.reduceat(error, bounds[:-1])).tolist():
            begin, end = bounds[place : place + 2].tolist()
            own = np.flatnonzero(error[begin:end]) + begin
            first, last = int(own[0]), int(own[-1])
            number = int(port[begin])
            voices = voice[slice(*np.searchsorted(port[voice], [number, number + 1]))]
            back = end < len(port) and port[end] == number
            before = voices[voices < first]
            steps = np.diff(times[before])
            silent = len(steps) >= _VOICES and not ((voices > first) & (voices < end)).any()
            step_ns = int(steps.mean()) if silent else 0
            start_ns, last_ns = times[[first, last]].tolist()
            end_ns = int(times[end]) if back else NEVER
            self.spans.append(ClosedSpan(endpoints[number], start_ns, last_ns, end_ns, len(own), step_ns))
            free = np.flatnonzero(events.unanswered[first:end]) + first
            self.closed[row[free[(free < last) & ~telling[free]]]] = True
            self.uncertain[row[free]] = True
            if step_ns and start_ns - times[before[-1]] <= _REGULAR * step_ns:
                late = np.arange(before[-1], first)
                late = late[times[late] >= start_ns - _UNREAD_NS]
                self.uncertain[row[late[events.unanswered[late]]]] = True

    def add_silent(self, rows: Rows, recorder: ErrorRecorder, endpoints: Sequence[Endpoint]) -> None:
        """Add the times in which robots fell silent, and mark what was sent to them as uncertain (rule 6)."""
        times, source = recorder.voices()[:2]
        host, robot = number_hosts(endpoints), rows.on(lambda link: link.last_hop)
        robot &= ~np.isin(host[rows.destination], host[rows.destination[self.closed]])
        for port, own in by_value(np.where(robot, rows.destination, -1)):
            heard, sent = np.sort(times[source == port]), rows.time_ns[own]
            if port < 0 or len(heard) <= _VOICES:
                continue
            usual, ends_ns = int(np.median(np.diff(heard))), np.append(heard[1:], NEVER)
            steps = np.minimum(ends_ns, rows.time_ns[-1]) - heard
            # On a network that loses some of what it sends, several in a row may be lost by chance.
            absent = int((np.rint(steps / max(usual, 1)) == 2).sum())
            in_a_row = log(_CHANCE / len(steps)) / log(absent / (absent + len(steps))) if absent > 1 else 0
            least_ns = max(_SILENT * usual, _PATIENCE_NS, in_a_row * usual)
            if (steps > least_ns).sum() > _OFTEN:  # such a pause is usual, too
                least_ns = max(least_ns, _SILENT * np.median(steps[steps > least_ns]))
            long = np.flatnonzero(steps > least_ns)
            for at in long.tolist() if len(long) < _SELDOM * len(heard) else ():
                start_ns, end_ns = int(heard[at]), int(ends_ns[at])
                inside = own[(sent > start_ns) & (sent <= end_ns)]
                # A time in which nothing was captured shows no silence.
                every = np.diff(rows.time_ns[slice(*np.searchsorted(rows.time_ns, (start_ns, end_ns)))])
                if len(inside) and every.sum() - every.max(initial=0) > least_ns:
                    self.uncertain[inside] = True
                    first, last = rows.time_ns[inside[[0, -1]]].tolist()
                    self.spans.append(ClosedSpan(endpoints[port], first, last, end_ns, 0, usual))


def count_lost(flow: Flow, sent_ns: Integers, errors_ns: list[int]) -> tuple[int, int]:
    """Return how many datagrams of a flow reached nobody, and how many more perhaps did not (rule 3).

    The second number is 0 unless the errors cover most of the flow's time, or quote most of its datagrams.

    Args:
        flow: flow to a port that no option names.
        sent_ns: i64, capture times of its datagrams, in order.
        errors_ns: capture times of the errors about it.
    """
    when = np.array([flow.first_ns, *sorted(errors_ns), flow.last_ns])
    steps, sent = np.diff(when), np.diff(np.searchsorted(sent_ns, when[1:-1], "right"))
    between = 1 + int(np.where(steps[1:-1] <= _PATIENCE_NS, sent, 1).sum())
    number = max(len(errors_ns), min(between, flow.datagrams))
    is_shut = 2 * int(steps[1:-1].sum()) > int(steps.sum()) or 2 * len(errors_ns) > flow.datagrams
    return number, max(0, flow.datagrams - number) * is_shut


def _quoted(rows: Rows, errors: PortErrors) -> Integers:
    """Return the row of the datagram that each error quotes, i64; -1 if it was not captured (rule 1).

    In order of time, datagrams are opening brackets and errors closing ones. An error quotes the datagram
    that its bracket closes.
    """
    way = rows.way()
    quoted = errors.source << 32 | errors.destination
    at = np.flatnonzero(np.isin(way, quoted))
    count, size = len(at), len(at) + len(quoted)
    number = np.concatenate((rows.identification[at].astype(np.int64), errors.identification))
    group = numbered(np.concatenate((way[at], quoted)), number)[1]
    late_ns = np.where(errors.identification != 0, _DISORDER_NS, 0)
    times = np.concatenate((rows.time_ns[at], errors.time_ns + late_ns))
    order = np.lexsort((np.arange(size) >= count, times, group))
    before, behind = (order[item] for item in brackets(group[order], order < count))
    error = behind - count
    late_ns = np.where(np.isin(errors.reason, NOT_JOINED), _JOIN_NS, _WITHIN_NS)
    near = times[behind] - times[before] <= late_ns[error]
    owner = np.full(len(quoted), -1)
    owner[error[near]] = at[before[near]]
    return owner


class _Events(NamedTuple):
    """The n events at ports that an error reports closed, by port, then by time.

    Attributes:
        port: i64 (n,), number of the endpoint.
        time_ns: i64 (n,), time of the event; of an error the time of its datagram, if that was captured.
        row: i64 (n,), row of the datagram, or of the quoted one; -1 if there is none.
        kind: (n,), ``_DATAGRAM`` to the port, ``_ERROR`` about it, or ``_VOICE``: a datagram from it.
        source: i64 (n,), endpoint that sent the datagram, or the quoted one; of a voice the port itself.
        unanswered: bool (n,), a datagram without an error.
    """

    port: Integers
    time_ns: Integers
    row: Integers
    kind: Integers
    source: Integers
    unanswered: Mask


def _events(
    rows: Rows, errors: PortErrors, quoted: Integers, closed: Mask, voices: tuple[Integers, Integers]
) -> _Events:
    to, out = (np.flatnonzero(np.isin(end, errors.destination)) for end in (rows.destination, rows.source))
    heard = np.isin(voices[1], errors.destination)
    spoke = rows.source[out], voices[1][heard]
    port: Integers = np.concatenate((rows.destination[to], errors.destination, *spoke))
    when = np.where(quoted >= 0, rows.time_ns[quoted], errors.time_ns)
    times = np.concatenate((rows.time_ns[to], when, rows.time_ns[out], voices[0][heard]))
    kind = np.repeat([_DATAGRAM, _ERROR, _VOICE], [len(to), len(quoted), len(out) + int(heard.sum())])
    row = np.concatenate((to, quoted, np.full(int((kind == _VOICE).sum()), -1)))
    source: Integers = np.concatenate((rows.source[to], errors.source, *spoke))
    order = np.lexsort((kind, times, port))
    row, kind = row[order], kind[order]
    unanswered = (kind == _DATAGRAM) & ~closed[row]
    return _Events(port[order], times[order], row, kind, source[order], unanswered)


def _telling(events: _Events, endpoints: Sequence[Endpoint]) -> Mask:
    """Return for which events the host would have sent an error to a closed port: bool (n,) (rule 3)."""
    host = number_hosts(endpoints)
    loops = np.array([ipaddress.ip_address(item.address).is_loopback for item in endpoints])
    at = np.flatnonzero(events.kind != _VOICE)
    is_error = events.kind[at] == _ERROR
    _, pair = numbered(host[events.port[at]], host[events.source[at]])
    order = np.lexsort((is_error, events.time_ns[at], pair))
    pair, times, is_error = pair[order], events.time_ns[at[order]], is_error[order]
    last = np.maximum.accumulate(np.where(is_error, np.arange(len(at)), -1))
    later = (last >= 0) & (pair[last] == pair)
    own, when = pair[is_error], times[is_error]
    many = own[_BURST:][(own[_BURST:] == own[:-_BURST]) & (when[_BURST:] - when[:-_BURST] < SECOND)]
    telling = np.zeros(len(events.port), bool)
    telling[at[order]] = ~later | (times - times[last] >= _PATIENCE_NS) | np.isin(pair, many)
    return np.asarray(telling | loops[events.port])


def _signs_of_life(events: _Events, telling: Mask) -> Mask:
    """Return which events are signs of life: no error about the next datagram to the port (rule 2)."""
    size = len(events.port)
    datagram = np.append(np.flatnonzero(events.kind == _DATAGRAM), size)
    behind = datagram[np.searchsorted(datagram, np.arange(size), "right")]
    following = np.minimum(behind, size - 1)
    has_next = (behind < size) & (events.port[following] == events.port)
    answered = has_next & events.unanswered[following]
    alone = (events.kind == _VOICE) & (answered | ~has_next)
    return np.asarray(alone | (events.unanswered & telling & answered))
