"""Ports that were closed for a time: what ICMP errors say of datagrams that reached nobody.

1. The datagram that an error quotes is lost. It is found by its endpoints and its IP identification: the last
   one before the error that no other error quotes.
2. A port is closed from the first error that its own host sends to the next sign of life: two datagrams in
   succession to it without an error, or one behind a datagram from it. One alone may have lost its error, and
   a port that is connected to another one speaks and hears nobody else.
3. A host may send few errors: Linux sends six at once and one a second to each receiver, but on loopback. A
   datagram without an error says that the port is open only where the host would have sent one. Of the rest,
   what lies between two errors is lost, and what comes after the last is uncertain.
4. What came to the port just before the first error, and after its last own datagram, may not have been read:
   it is uncertain, where the port speaks regularly.
5. An error of another host, or of another kind, is about its own datagram alone.
"""

from __future__ import annotations

import ipaddress
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.diagnosis.evidence.fingerprint import brackets
from edoras_tools.diagnosis.evidence.table import Rows, number_hosts
from edoras_tools.diagnosis.evidence.timeline.table import NEVER
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire.arrays.order import Integers, Mask, numbered

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.decode.conversations import Flow
    from edoras_tools.diagnosis.evidence.port_errors import ErrorRecorder, PortErrors
    from edoras_tools.model import Endpoint

_WITHIN_NS: Final = 5 * SECOND
"""An error comes so long after its datagram at most."""
_DISORDER_NS: Final = 50 * MILLISECOND
"""A capture may put an error so long before its datagram, where its identification tells that one."""
_PATIENCE_NS: Final = 1200 * MILLISECOND
"""So long after its last error a host sends another one."""
_UNREAD_NS: Final = 600 * MILLISECOND
"""A program that ends has read what came so long before: it wakes up twice a second, or at once."""
_BURST: Final = 7
"""A host that counts its errors sends fewer within a second."""
_DATAGRAM, _ERROR, _VOICE = range(3)
_VOICES: Final = 3
_REGULAR: Final = 2
"""A port speaks regularly if it sent so many datagrams, and was silent for no more than so many steps."""


class ClosedSpan(NamedTuple):
    """A time in which a port was closed.

    Attributes:
        port: its endpoint.
        start_ns: the datagram that the first error quotes.
        last_ns: the datagram that the last one quotes.
        end_ns: the next sign of life; ``NEVER`` where there is none.
        errors: how many.
        step_ns: how often the port spoke before, if it fell silent; else 0.
    """

    port: Endpoint
    start_ns: int
    last_ns: int
    end_ns: int
    errors: int
    step_ns: int = 0


class Unreachable(NamedTuple):
    """What reached nobody.

    Attributes:
        closed: bool (rows,), which datagrams went to a closed port.
        refused: bool (rows,), which others an error quotes.
        uncertain: bool (rows,), which may have gone to a closed port, or were not read there.
        spans: when ports were closed, by port and time.
    """

    closed: Mask
    refused: Mask
    uncertain: Mask
    spans: Sequence[ClosedSpan] = ()


def count_shut(flow: Flow, sent_ns: Integers, errors_ns: list[int]) -> tuple[int, int]:
    """Return of how many of a flow errors tell that they reached nobody, and of how many more that they may.

    Args:
        flow: to a port that nobody named.
        sent_ns: when its datagrams were captured, in order.
        errors_ns: when each error about it came: about most of it, or most of the time. What lies between two
            that came as often as a host sends any is lost (rule 3).
    """
    when = np.array([flow.first_ns, *sorted(errors_ns), flow.last_ns])
    steps, sent = np.diff(when), np.diff(np.searchsorted(sent_ns, when[1:-1], "right"))
    number = max(len(errors_ns), 1 + int(np.where(steps[1:-1] <= _PATIENCE_NS, sent, 1).sum()))
    is_shut = 2 * int(steps[1:-1].sum()) > int(steps.sum()) or 2 * len(errors_ns) > flow.datagrams
    return number, max(0, flow.datagrams - number) * is_shut


def find_unreachable(
    rows: Rows, recorder: ErrorRecorder, endpoints: Sequence[Endpoint], translated: Mapping[str, str]
) -> Unreachable:
    """Return what the errors of a capture say of its datagrams.

    Args:
        rows: in order of time.
        recorder: has the errors.
        endpoints: what ``source`` and ``destination`` of the rows index.
        translated: address to the address that it is another name of.
    """
    errors = recorder.errors()
    marks = Unreachable(np.zeros(len(rows), bool), np.zeros(len(rows), bool), np.zeros(len(rows), bool))
    if not len(errors.print) or not len(rows):
        return marks
    number = {endpoint: at for at, endpoint in enumerate(endpoints)}
    same = [replace(item, address=translated.get(item.address, item.address)) for item in endpoints]
    names = np.array([number.get(item, at) for at, item in enumerate(same)])
    errors = errors._replace(source=names[errors.source], destination=names[errors.destination])
    row = _quoted(rows, errors)
    marks.refused[row[(row >= 0) & ~errors.closed]] = True
    closing, own = errors.take(errors.closed), row[errors.closed]
    marks.closed[own[own >= 0]] = True
    times, sources = recorder.voices()[:2]
    events = _events(rows, closing, own, marks.closed, (times, names[sources]))
    spans = _spans(events, _telling(rows, closing, events, endpoints), endpoints, marks)
    marks.refused[marks.closed] = False
    marks.uncertain[marks.closed | marks.refused] = False
    return Unreachable(marks.closed, marks.refused, marks.uncertain, spans)


def _quoted(rows: Rows, errors: PortErrors) -> Integers:
    """Return the row of the datagram that each error quotes; -1 where it is not there (rule 1).

    In order of time datagrams are opening brackets and errors closing ones: an error is about the datagram
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
    near = times[behind] - times[before] <= _WITHIN_NS
    owner = np.full(len(quoted), -1)
    owner[behind[near] - count] = at[before[near]]
    return owner


class _Events(NamedTuple):
    """Datagrams to ports that were closed, errors about them, datagrams from them: by port, then by time.

    Attributes:
        port: i64, number of the endpoint.
        time_ns: i64; of an error that of its datagram, if that is there.
        row: i64, the datagram, or the one that an error quotes; -1 where it is not there.
        kind: 0 to 2, see above.
        error: i64, place of an error among the errors; else meaningless.
        unanswered: bool, a datagram without an error.
    """

    port: Integers
    time_ns: Integers
    row: Integers
    kind: Integers
    error: Integers
    unanswered: Mask


def _events(
    rows: Rows, errors: PortErrors, quoted: Integers, closed: Mask, voices: tuple[Integers, Integers]
) -> _Events:
    to, out = (np.flatnonzero(np.isin(end, errors.destination)) for end in (rows.destination, rows.source))
    heard = np.isin(voices[1], errors.destination)
    port: Integers
    port = np.concatenate((rows.destination[to], errors.destination, rows.source[out], voices[1][heard]))
    when = np.where(quoted >= 0, rows.time_ns[quoted], errors.time_ns)
    times = np.concatenate((rows.time_ns[to], when, rows.time_ns[out], voices[0][heard]))
    kind = np.repeat([0, 1, 2], [len(to), len(quoted), len(out) + int(heard.sum())])
    row = np.concatenate((to, quoted, np.full(int((kind == _VOICE).sum()), -1)))
    order = np.lexsort((kind, times, port))
    row, kind = row[order], kind[order]
    unanswered = (kind == _DATAGRAM) & ~closed[row]
    return _Events(port[order], times[order], row, kind, order - len(to), unanswered)


def _telling(rows: Rows, errors: PortErrors, events: _Events, endpoints: Sequence[Endpoint]) -> Mask:
    """Tell of which datagrams an error would have been sent, had their port been closed (rule 3)."""
    host = number_hosts(endpoints)
    loops = np.array([ipaddress.ip_address(item.address).is_loopback for item in endpoints])
    at = np.flatnonzero(events.kind != _VOICE)
    is_error = events.kind[at] == _ERROR
    source = np.zeros(len(at), np.int64)
    source[is_error] = errors.source[events.error[at[is_error]]]
    source[~is_error] = rows.source[events.row[at[~is_error]]]
    _, pair = numbered(host[events.port[at]], host[source])
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
    """Tell which events show that their port is open: no error about the next datagram to it (rule 2)."""
    size = len(events.port)
    datagram = np.append(np.flatnonzero(events.kind == _DATAGRAM), size)
    behind = datagram[np.searchsorted(datagram, np.arange(size), "right")]
    following = np.minimum(behind, size - 1)
    has_next = (behind < size) & (events.port[following] == events.port)
    answered = has_next & events.unanswered[following]
    alone = (events.kind == _VOICE) & (answered | ~has_next)
    return np.asarray(alone | (events.unanswered & telling & answered))


def _spans(
    events: _Events, telling: Mask, endpoints: Sequence[Endpoint], marks: Unreachable
) -> list[ClosedSpan]:
    """Return when ports were closed; mark the datagrams of rules 3 and 4 in ``marks``."""
    port, times, row = events[:3]
    voice, error = np.flatnonzero(events.kind == _VOICE), events.kind == _ERROR
    life = _signs_of_life(events, telling)
    fresh = np.ones(len(port), bool)
    fresh[1:] = port[1:] != port[:-1]
    bounds = np.append(np.flatnonzero(life | fresh), len(port))
    spans = []
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
        span = ClosedSpan(
            endpoints[number],
            int(times[first]),
            int(times[last]),
            int(times[end]) if back else NEVER,
            len(own),
            int(steps.mean()) if silent else 0,
        )
        spans.append(span)
        free = np.flatnonzero(events.unanswered[first:end]) + first
        marks.closed[row[free[(free < last) & ~telling[free]]]] = True
        marks.uncertain[row[free]] = True
        if span.step_ns and span.start_ns - times[before[-1]] <= _REGULAR * span.step_ns:
            late = np.arange(before[-1], first)
            late = late[times[late] >= span.start_ns - _UNREAD_NS]
            marks.uncertain[row[late[events.unanswered[late]]]] = True
    return spans
