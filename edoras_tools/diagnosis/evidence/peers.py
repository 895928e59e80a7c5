"""The connections of the Software Bus Network over time, as each cFS sees them.

A peer is connected from its first datagram until it sends DISCONNECT, or nothing for eleven seconds. Over TCP
silence ends nothing: cFS has no time-out there, and who leaves closes the connection.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np

from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.model import Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays.order import Integers, Places, by_key, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.table import Rows

ObservedState = Literal["connected", "silent", "timed_out", "disconnected"]
_LEAST_ROWS: Final = 3
_ALREADY_NS: Final = SECOND
_BEGINS: Final = frozenset({sbn.MsgType.SUB, sbn.MsgType.PROTO, sbn.MsgType.ANNOUNCE})
"""What a peer says first: one whose first datagram here is another was connected before the capture began."""
_BEGAN: Final = frozenset(f"its {kind.name} arrived" for kind in _BEGINS)
_NEVER: Final = np.iinfo(np.int64).max // 2
_STILL_NS: Final = 3 * SECOND
"""After a time-out, nobody sends to a peer for longer than this."""
_ANSWERS_NS: Final = 500 * MILLISECOND
_SHORT_NS: Final = 2 * SECOND
_FACTOR: Final = 4
_LEAST_STEPS: Final = 8
"""A peer that sends at least so often, and then nothing for so many of its usual pauses, may be gone."""
_RARE_NS: Final = 30 * SECOND
"""Who subscribes more often, all in all, repeats it by habit."""
ALREADY: Final = "it was when the capture began"
SAID_GOODBYE: Final = "the observer sent it DISCONNECT"
UNSEEN: Final = "nothing of it is seen here since, yet the observer goes on sending to it"


SbnParty = tuple[str, int]
"""An identity, as ``66:3``, and the number of the address that it speaks from."""


class PeerChange(NamedTuple):
    """A peer's state from a time on."""

    time_ns: int
    state: ObservedState
    why: str


class PeerSilence(NamedTuple):
    """A time in which a peer said nothing: from its last datagram to its next, or to the end.

    ``given_up`` tells whether it lasted until its observer timed it out; ``change`` is the place of its
    beginning in the connection's changes. ``stood_still`` tells whether it then went on as one that was not
    started again: it did not subscribe first.
    """

    start_ns: int
    until_ns: int
    given_up: bool
    change: int
    stood_still: bool


class PeerRestart(NamedTuple):
    """A peer that was started again before it was given up: it never said that it was gone.

    ``last_ns`` is its last datagram before that, ``dead_ns`` when it would have sent the next one had it
    run, ``back_ns`` when it subscribed anew. What came until ``read_ns`` it surely read: one that answers,
    what it answered.
    """

    last_ns: int
    dead_ns: int
    back_ns: int
    rows: tuple[int, int]
    read_ns: int


class Connection(msgspec.Struct):
    """A peer as one cFS sees it.

    Attributes:
        peer: who is seen, as ``66:3``.
        observer: the cFS that sees it.
        changes: its states, in order of time.
        sent_ns: capture times of application messages that the observer sent to it.
        restarts: when it was started again without a word, in order.
    """

    peer: str
    observer: str
    changes: list[PeerChange]
    sent_ns: Integers
    restarts: list[PeerRestart]

    def silences(self, end_ns: int) -> Iterator[PeerSilence]:
        """Yield every silence that the observer noticed, and one that lasts to the end of the capture."""
        for at, change in enumerate(self.changes):
            if change.state != "silent" or change.why == UNSEEN:
                continue
            later = self.changes[at + 1 :]
            backs = (item for item in later if item.state == "connected")
            back = next(backs, PeerChange(end_ns, "silent", ""))
            given_up = bool(later) and later[0].state == "timed_out"
            still = back.why.startswith("its ") and back.why not in _BEGAN
            yield PeerSilence(change.time_ns, back.time_ns, given_up, at, still)

    def sent_in(self, silence: PeerSilence) -> Integers:
        """Return when application messages were sent to it in a silence."""
        return self.sent_ns[(self.sent_ns > silence.start_ns) & (self.sent_ns < silence.until_ns)]

    def as_json(self) -> dict[str, Any]:
        """Return the connection in the shape of ``doctor --json``."""
        return {
            "peer": self.peer,
            "observer": self.observer,
            "states": [change._asdict() for change in self.changes],
        }


class Network:
    """All peers of the Software Bus Network.

    Attributes:
        identity_of: endpoint to the identity that sends from it.
        connections: by (peer, observer), each an identity and the number of its address.
        datagrams: identity to datagrams sent.
    """

    def __init__(
        self,
        rows: Rows,
        instances: Instances,
        profile: SimProfile,
        outages: Sequence[tuple[int, int]] = (),
    ) -> None:
        """Follow every connection.

        Args:
            outages: from when to when the capturing interface was away: silence then tells nothing.
        """
        self.identity_of: dict[int, str] = {}
        self.connections: dict[tuple[SbnParty, SbnParty], Connection] = {}
        self._outages = outages
        self._hosts = instances.hosts
        self.datagrams: Counter[str] = Counter()
        self._profile = profile
        network = np.flatnonzero(rows.on(lambda link: link.peers) & (rows.sbn_msg_type >= 0))
        if not len(network):
            return
        self._identify(rows, network)
        flight_software = {item.name for item in instances.items if item.name}
        # Where the capture cut the time off: who counts what it sends is a cFS, bridges never do.
        counting = rows.counted[network] & rows.has(Finding.CAPTURE_CUT, network)
        own = network[(instances.of_row[network] != NOBODY) | counting]
        speakers = {self.identity_of.get(source, "") for source in np.unique(rows.source[own]).tolist()}
        flight_software |= speakers - {""}
        self._connect(rows, network, flight_software)

    def _identify(self, rows: Rows, network: Places) -> None:
        short = rows.has(Finding.TRUNCATED, network) & ~rows.has(Finding.CAPTURE_CUT, network)
        sound = network[~(rows.has(Finding.SBN_UNKNOWN_TYPE, network) | short)]
        for source, own in groups(rows.source, sound):
            name, number = rows.usual_sender(own)
            if number >= _LEAST_ROWS:
                self.identity_of[source] = name
            self.datagrams[name] += number

    def party(self, endpoint: int) -> SbnParty:
        """Return the party at an endpoint; two with one identity are distinguished by their addresses."""
        return self.identity_of.get(endpoint, ""), int(self._hosts[endpoint])

    def _connect(self, rows: Rows, network: Places, flight_software: set[str]) -> None:
        parties = [self.party(endpoint) for endpoint in range(len(self._hosts))]
        first, way = numbered(rows.source[network], rows.destination[network])
        source, target = rows.source[network[first]], rows.destination[network[first]]
        ways = by_key(range(len(first)), lambda at: (parties[source[at]], parties[target[at]]))
        end_ns = int(rows.time_ns[-1])
        for peer, observer in sorted(ways):
            if peer[0] and observer[0] in flight_software and peer != observer:
                heard = network[np.isin(way, ways[peer, observer])]
                sent = network[np.isin(way, ways.get((observer, peer), []))]
                signs = sent if len(sent) else heard
                app = sent[rows.sbn_msg_type[sent] == sbn.MsgType.APP]
                alive_ns = int(rows.time_ns[signs[0]])
                changes = self._changes(rows, heard, alive_ns, end_ns, _farewells(rows, sent))
                changes = _believed(changes, rows.time_ns[app])
                changes = _greeted(changes, rows, sent, app)
                self.connections[peer, observer] = Connection(
                    peer[0], observer[0], changes, rows.time_ns[app], _restarts(rows, heard, sent, changes)
                )

    def _changes(
        self, rows: Rows, heard: Places, alive_ns: int, end_ns: int, farewells: list[tuple[int, int]]
    ) -> list[PeerChange]:
        """Follow one peer's datagrams to one observer, who is there from ``alive_ns`` on.

        Args:
            heard: the peer's datagrams to the observer.
            alive_ns: the observer's first datagram.
            end_ns: the last of the capture.
            farewells: see ``_farewells``.
        """
        timeout = self._profile.sbn_timeout_s * SECOND
        silent = (self._profile.sbn_heartbeat_s + 1) * SECOND
        if rows.streamed[heard].any():
            timeout = silent = _NEVER
        begin_ns = int(rows.time_ns[0])
        changes: list[PeerChange] = []
        up, away = False, [*farewells, (np.iinfo(np.int64).max, 0)]
        times, kinds = rows.time_ns[heard], rows.sbn_msg_type[heard]
        # While it is connected only a silence and a DISCONNECT, and what follows one, change anything.
        ends = (times < alive_ns - 500 * MILLISECOND) | (kinds == sbn.MsgType.DISCONNECT)
        changing = ends | np.append(True, ends)[: len(ends)] | (np.diff(times, prepend=0) >= timeout)
        for at in np.flatnonzero(changing | bool(farewells)).tolist():
            now, kind, last = int(times[at]), int(kinds[at]), int(times[at - 1])
            if now > away[0][0]:
                if up:
                    changes.append(PeerChange(away[0][0], "disconnected", SAID_GOODBYE))
                up = False
                if now < away[0][1]:
                    continue  # what it is sent, the observer does not take
                away.pop(0)
            # What came before the observer was there, nobody heard.
            if now < alive_ns - 500 * MILLISECOND:
                continue
            if up and now - last >= timeout and now - last >= timeout + self._away(last, now):
                changes += self._silence(last, timeout)
                up = False
            if kind == sbn.MsgType.DISCONNECT:
                if up:
                    changes.append(PeerChange(now, "disconnected", "it sent DISCONNECT"))
                up = False
            elif not up:
                began = kind in _BEGINS
                first = not changes and now - begin_ns < (_ALREADY_NS if began else timeout)
                why = ALREADY if first else f"its {sbn.MSG_TYPE_NAMES.get(kind, f'type {kind:#04x}')} arrived"
                changes.append(PeerChange(now, "connected", why))
                up = True
        last = int(times[-1]) if up else 0
        if up and away[0][0] <= end_ns:
            changes.append(PeerChange(away[0][0], "disconnected", SAID_GOODBYE))
        elif up and (quiet := end_ns - last - self._away(last, end_ns)) >= timeout + SECOND:
            changes += self._silence(last, timeout)
        elif up and quiet >= silent:
            text = f"nothing from it since, {(end_ns - last) / SECOND:.1f} s to the end of the capture"
            changes.append(PeerChange(last, "silent", text))
        return changes

    def _away(self, start_ns: int, end_ns: int) -> int:
        """Return for how long of a time the capturing interface was away."""
        return sum(max(0, min(end, end_ns) - max(start, start_ns)) for start, end in self._outages)

    @staticmethod
    def _silence(last: int, timeout: int) -> list[PeerChange]:
        return [
            PeerChange(last, "silent", "its last datagram; it was killed, stopped or cut off"),
            PeerChange(last + timeout, "timed_out", f"{timeout // SECOND} s without a word"),
        ]

    def crossing(self, sender: int, receiver: int) -> Connection | None:
        """Return the receiving peer's connection, as the sending cFS sees it."""
        return self.connections.get((self.party(receiver), self.party(sender)))


def _farewells(rows: Rows, sent: Places) -> list[tuple[int, int]]:
    """Return when an observer sent DISCONNECT, and from when on it took the peer's datagrams again.

    It does so when it sends anything else to it: it answers what comes. Never is the largest time there is.
    """
    goodbye = rows.sbn_msg_type[sent] == sbn.MsgType.DISCONNECT
    others = rows.time_ns[sent[~goodbye]]
    spans: list[tuple[int, int]] = []
    for when in rows.time_ns[sent[goodbye]].tolist():
        at = int(np.searchsorted(others, when, "right"))
        again = int(others[at]) - _ANSWERS_NS if at < len(others) else int(np.iinfo(np.int64).max)
        if not spans or when > spans[-1][1]:
            spans.append((when, again))
    return spans


def _believed(changes: list[PeerChange], sent_ns: Integers) -> list[PeerChange]:
    """Take back time-outs that the observer did not see: it went on sending, so the peer was heard there."""
    out: list[PeerChange] = []
    for at, change in enumerate(changes):
        until = changes[at + 1].time_ns if at + 1 < len(changes) else np.iinfo(np.int64).max
        late = (sent_ns > change.time_ns + _STILL_NS) & (sent_ns < until)
        if change.state == "timed_out" and late.any():
            out[-1] = out[-1]._replace(why=UNSEEN)
            continue
        out.append(change)
    return out


def _greeted(changes: list[PeerChange], rows: Rows, sent: Places, app: Places) -> list[PeerChange]:
    """Add time-outs that no silence shows: the observer kept back messages, and then subscribed anew.

    It may not have read what it was sent meanwhile.
    """
    out, app_ns = list(changes), rows.time_ns[app]
    subscribed = rows.time_ns[sent[rows.sbn_msg_type[sent] == sbn.MsgType.SUB]]
    behind = np.searchsorted(app_ns, subscribed)
    # Nothing is missing before the first, nor behind the last.
    lacking = np.concatenate(([0], rows.missing[app[1:]], [0]))[behind] != 0
    for when, later in zip(subscribed[lacking].tolist(), behind[lacking].tolist(), strict=True):
        place = bisect_right(out, when, key=attrgetter("time_ns"))
        if place and out[place - 1].state == "connected":
            last_ns = int(app_ns[later - 1])
            if out[place - 1].time_ns < last_ns < when - _STILL_NS:
                lost = PeerChange(last_ns + 1, "timed_out", "the observer sent it nothing any more")
                out[place:place] = [lost, PeerChange(when, "connected", "the observer subscribed anew")]
    return out


def _restarts(rows: Rows, heard: Places, sent: Places, changes: list[PeerChange]) -> list[PeerRestart]:
    """Return the restarts of a peer: it was silent for long while it was sent to, and then subscribed anew.

    A bridge that repeats its subscriptions does so after any silence. Where it answers what it is sent, it
    was started again if it never answered what it was sent in the silence.
    """
    steps = np.diff(rows.time_ns[heard])
    if len(steps) < _LEAST_STEPS or rows.streamed[heard].any():
        return []
    kinds, times, sent_ns = rows.sbn_msg_type[heard], rows.time_ns[heard], rows.time_ns[sent]
    usual_ns = int(np.quantile(steps, 0.95))
    subs = np.flatnonzero(kinds == sbn.MsgType.SUB)
    subscribes = times[subs]
    # All that it asks for at once is one time; one that repeats does so every few seconds.
    begins = int((np.diff(subscribes, prepend=0) > SECOND // 4).sum())
    repeats = begins > 2 + len(changes) + (times[-1] - times[0]) // _RARE_NS
    answers = times[kinds == sbn.MsgType.PROTO]
    app_ns = sent_ns[rows.sbn_msg_type[sent] == sbn.MsgType.APP]
    answering = 2 * len(answers) >= len(app_ns)
    # What one that answers does not answer shows a shorter silence, too.
    long_ns = max(_SHORT_NS // 3, 2 * usual_ns) if answering else max(_SHORT_NS, _FACTOR * usual_ns)
    restarts = []
    for place in np.flatnonzero(steps > long_ns).tolist():
        start_ns, end_ns = times[place : place + 2].tolist()
        followed = any(start_ns <= item.time_ns < end_ns for item in changes)
        read_ns = int(answers[answers <= start_ns].max(initial=0)) if answering else start_ns
        unread_ns = read_ns if answering else start_ns + usual_ns
        number = int(((app_ns > unread_ns) & (app_ns < end_ns)).sum())
        again = subs[(subscribes >= end_ns) & (subscribes < end_ns + SECOND // 4)]
        if followed or not number or not len(again):
            continue
        if repeats:
            beyond = [
                ((answers > end_ns) & (answers < until)).sum()
                - ((sent_ns > end_ns) & (sent_ns < until)).sum()
                for until in (end_ns + _ANSWERS_NS, end_ns + _STILL_NS)
            ]
            if not answering or max(beyond) > number // 2 or len(answers) + number > len(sent_ns):
                continue
        around = int(heard[place]), int(heard[again[0]])
        restarts.append(PeerRestart(start_ns, start_ns + usual_ns, end_ns, around, read_ns))
    return restarts
