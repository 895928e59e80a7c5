"""The connections of the Software Bus Network over time, as each cFS sees them.

Rules:

1. A peer is connected from its first datagram until it sends DISCONNECT, or is silent for the time-out, 11 s.
2. Over TCP silence ends nothing: cFS has no time-out there, and a peer that leaves closes the connection.
3. A time-out holds only if the observer stopped sending. If it went on, it heard the peer, and the capture
   did not.
4. If the observer stopped sending and then subscribed again, it had timed the peer out, though the capture
   shows no silence.
5. A peer restarted if it was silent while messages were sent to it, and then subscribed again.
6. An observer that had sent nothing itself, not even a heartbeat, was given up by the peer, which is silent
   for that: then rules 3 and 5 do not hold.
"""

from __future__ import annotations

from bisect import bisect_right
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from edoras_tools.diagnosis.evidence.instances import NOBODY, Instances
from edoras_tools.model import Finding
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import sbn
from edoras_tools.wire.arrays import Integers, Places, by_key, distinct, groups, numbered

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.evidence.table import Rows

ObservedState = Literal["connected", "silent", "timed_out", "disconnected"]
_LEAST_ROWS: Final = 3
_GREETINGS: Final = sbn.MsgType.SUB, sbn.MsgType.PROTO, sbn.MsgType.ANNOUNCE
_BEGAN: Final = frozenset(f"its {sbn.MSG_TYPE_NAMES[kind]} arrived" for kind in _GREETINGS)
"""Reasons of a new connection; with any other message first, the peer did not begin it anew."""
_TO_CONNECTED: Final = sbn.MsgType.PROTO, sbn.MsgType.APP, sbn.MsgType.HEARTBEAT
"""What a cFS sends only to a peer that is connected; its lists go to all peers of its table."""
_NEVER: Final = np.iinfo(np.int64).max // 2
_STILL_NS: Final = 3 * SECOND
"""Longest time for which an observer still sends after a time-out."""
_SHORT_NS: Final = 2 * SECOND
_FACTOR: Final = 4
_LEAST_STEPS: Final = 8
"""A restart shows only at a peer with this many pauses, by a silence of ``_FACTOR`` usual ones."""
_MANY_STEPS: Final = 40
"""The last steps of a peer, if so many, show how long it ever paused."""
_RARE_NS: Final = 30 * SECOND
"""A peer that subscribes more often than this repeats its subscriptions by habit."""
ALREADY: Final = "it was when the capture began"
SAID_GOODBYE: Final = "the observer sent it DISCONNECT"
UNSEEN: Final = "nothing of it is seen here since, yet the observer goes on sending to it"


SbnParty = tuple[str, int]
"""An identity, as ``66:3``, and the number of the address that it sends from."""


class PeerChange(NamedTuple):
    """A peer's state from a time on, ns, and the reason for people."""

    time_ns: int
    state: ObservedState
    why: str


class PeerSilence(NamedTuple):
    """A time in which a peer sent nothing.

    Attributes:
        start_ns: time of its last datagram before the silence.
        until_ns: time of its next one, or the end of the capture.
        due_ns: time at which its next one was due: it may have received messages until then.
        given_up_ns: when the observer timed the peer out; 0 if it did not.
        stood_still: whether the peer went on without a new subscription, or answered what it had been sent
            meanwhile, so that it had not restarted.
        answers: number of its answers then to what it had been sent meanwhile.
    """

    start_ns: int
    until_ns: int
    due_ns: int
    given_up_ns: int
    stood_still: bool
    answers: int

    @property
    def sent_until_ns(self) -> int:
        """Time until which it was sent messages: later ones went to a peer that was back, seen or not."""
        return min(self.until_ns, self.given_up_ns + _STILL_NS if self.given_up_ns else _NEVER)

    def within(self, sent_ns: Integers) -> Integers:
        """Return which of some times, i64 ns, of messages to it are in the silence."""
        return sent_ns[(sent_ns > self.start_ns) & (sent_ns < self.sent_until_ns)]


class PeerRestart(NamedTuple):
    """A restart of a peer before its time-out, without a DISCONNECT.

    Attributes:
        last_ns: time of its last datagram before the restart.
        dead_ns: time at which its next datagram was due.
        back_ns: time at which the silence ended.
        rows: rows of its last datagram, and of its first SUB behind the silence.
        read_ns: time until which it surely read its datagrams; for a peer that answers, its last answer.
    """

    last_ns: int
    dead_ns: int
    back_ns: int
    rows: tuple[int, int]
    read_ns: int


class Connection:
    """The connection of a peer, as one cFS sees it.

    Args:
        ends: the peer, and the observer.
        rows: table of datagrams.
        heard: rows that the peer sent to the observer; at least one.
        sent: rows that the observer sent to the peer.
        network: all peers, with the constants of SBN.

    Attributes:
        peer: identity of the peer, as ``66:3``.
        observer: identity of the cFS that sees it.
        changes: states of the peer, in order of time.
        heard: rows that the peer sent to the observer.
        sent: rows that the observer sent to the peer.
        sent_ns: i64, capture times of application messages that the observer sent to it.
        said_ns: i64, capture times of all that the observer sent to it.
        restarts: restarts of the peer before a time-out, in order.
        heard_ns: i64, capture times of all that the peer sent to the observer.
        seldom_ns: time within which it surely sends something, a heartbeat at least.
        streamed: whether it speaks over TCP.
        voices_ns: i64, capture times of all that the peer sent, also to other ports.
    """

    def __init__(
        self, ends: tuple[SbnParty, SbnParty], rows: Rows, heard: Places, sent: Places, network: Network
    ) -> None:
        self.peer, self.observer = (name for name, _ in ends)
        self._rows, self.heard, self.sent, self._outages = rows, heard, sent, network.outages
        self.heard_ns, self._kinds = rows.time_ns[heard], rows.sbn_msg_type[heard]
        self.said_ns, kinds = rows.time_ns[sent], rows.sbn_msg_type[sent]
        app, subs = sent[kinds == sbn.MsgType.APP], self.said_ns[kinds == sbn.MsgType.SUB]
        self.sent_ns = rows.time_ns[app]
        self.voices_ns = rows.time_ns[np.isin(rows.source, np.unique(rows.source[heard]))]
        self._answers = self.heard_ns[self._kinds == sbn.MsgType.PROTO]
        self.seldom_ns, self._timeout_ns = network.seldom_ns, network.timeout_ns
        self.streamed = bool(rows.streamed[heard].any())
        to_connected = sent[np.isin(kinds, _TO_CONNECTED)]
        greeted = (rows.sbn_msg_type[to_connected[:1]] == sbn.MsgType.PROTO).any()
        first = int(np.append(to_connected if greeted else sent, heard)[0])
        self.changes = self._states(first, _disconnect_spans(self.said_ns, kinds))
        self._believe()
        self._add_unseen(subs, rows.missing[app[1:]])
        quiet = [at for at, own in enumerate(self.changes) if own.state == "silent"]
        mute = [at for at in quiet if not self._spoke(self.changes[at].time_ns)]
        mute += [at + 1 for at in mute if self.changes[at].why != UNSEEN]
        self.changes = [own for at, own in enumerate(self.changes) if at not in mute]
        every = (item for item in self._find_restarts() if self._spoke(item.last_ns))
        self.restarts = [item for item in every if not self.runs(item.last_ns, item.back_ns)]

    def runs(self, start_ns: int, end_ns: int) -> bool:
        """Return whether the peer sends to other ports in most of a silence: so it reads what it is sent."""
        inside = self.voices_ns[(self.voices_ns > start_ns) & (self.voices_ns < end_ns)]
        return bool(2 * np.diff(inside, prepend=start_ns, append=end_ns).max() < end_ns - start_ns)

    def silences(self, end_ns: int) -> Iterator[PeerSilence]:
        """Yield every silence with a time-out, and one that lasts to the end of the capture."""
        for at, change in enumerate(self.changes, 1):
            if change.state != "silent" or change.why == UNSEEN:
                continue
            later = self.changes[at:]
            back = next((item for item in later if item.state == "connected"), None)
            given_up_ns = later[0].time_ns if later and later[0].state == "timed_out" else 0
            answers = self._late_answers(back.time_ns) if back else 0
            # Its next datagram was due by its last steps, or else a heartbeat.
            steps = np.diff(self.heard_ns[self.heard_ns <= change.time_ns])[-_LEAST_STEPS:]
            due_ns = change.time_ns + (self.seldom_ns if len(steps) < _LEAST_STEPS else int(steps.max()))
            until_ns = back.time_ns if back else end_ns
            still = back is not None and back.why.startswith("its ") and back.why not in _BEGAN
            silence = PeerSilence(change.time_ns, until_ns, due_ns, given_up_ns, still, answers)
            still |= answers > max(_LEAST_ROWS, len(silence.within(self.sent_ns)) // 2)
            still |= self.runs(change.time_ns, until_ns)
            yield silence._replace(stood_still=still)

    def as_json(self) -> dict[str, Any]:
        """Return the connection in the shape of ``doctor --json``."""
        states = [change._asdict() for change in self.changes]
        return {"peer": self.peer, "observer": self.observer, "states": states}

    def _states(self, first: int, farewells: list[tuple[int, int]]) -> list[PeerChange]:
        """Return the states of the peer, from its datagrams.

        Args:
            first: row of the observer's PROTO that begins its first connection, else its first datagram.
            farewells: result of ``_disconnect_spans``.
        """
        timeout = _NEVER if self.streamed else self._timeout_ns
        begin_ns, alive_ns, end_ns = self._rows.time_ns[[0, first, -1]].tolist()
        begins = self._rows.sbn_msg_type[first] == sbn.MsgType.PROTO
        changes: list[PeerChange] = []
        up, away = False, [*farewells, (np.iinfo(np.int64).max, 0)]
        # Nobody heard datagrams before the observer was running.
        audible = self.heard_ns >= alive_ns - 500 * MILLISECOND
        times, kinds = self.heard_ns[audible], self._kinds[audible]
        # Only these can change the state: a DISCONNECT, the datagram behind it, and one after a silence.
        ends = kinds == sbn.MsgType.DISCONNECT
        changing = ends | np.append(True, ends)[: len(ends)] | (np.diff(times, prepend=0) >= timeout)
        for at in np.flatnonzero(changing | bool(farewells)).tolist():
            now, kind, last = int(times[at]), int(kinds[at]), int(times[at - 1])
            if now > away[0][0]:
                if up:
                    changes.append(PeerChange(away[0][0], "disconnected", SAID_GOODBYE))
                up = False
                if now < away[0][1]:
                    continue  # the observer does not accept this datagram
                away.pop(0)
            # Nothing at all may come from the last message before a time-out on.
            if up and now - last >= timeout and now - last > timeout + self._away(last, now) - SECOND:
                changes += _silence(last, timeout)
                up = False
            if kind == sbn.MsgType.DISCONNECT:
                if up:
                    changes.append(PeerChange(now, "disconnected", "it sent DISCONNECT"))
                up = False
            elif not up:
                begun_ns = SECOND if kind in _GREETINGS else timeout
                older = not (changes or begins) and now - begin_ns < begun_ns
                why = ALREADY if older else f"its {sbn.MSG_TYPE_NAMES.get(kind, f'type {kind:#04x}')} arrived"
                changes.append(PeerChange(now, "connected", why))
                up = True
        last = int(times[-1]) if up else 0
        if up and away[0][0] <= end_ns:
            changes.append(PeerChange(away[0][0], "disconnected", SAID_GOODBYE))
        elif up and (quiet := end_ns - last - self._away(last, end_ns)) >= timeout + SECOND:
            changes += _silence(last, timeout)
        elif up and quiet >= self._hushed_ns(times):
            text = f"nothing from it since, {(end_ns - last) / SECOND:.1f} s to the end of the capture"
            changes.append(PeerChange(last, "silent", text))
        return changes

    def _hushed_ns(self, times: Integers) -> int:
        """Return how long a peer that speaks at these times is silent only if it does not run, ns.

        Silence says nothing where everything ends, so it must have answered, and be sent to.
        """
        steps, answering = np.diff(times)[-_MANY_STEPS:], 2 * len(self._answers) >= len(self.sent_ns)
        often = len(steps) == _MANY_STEPS and (self.sent_ns > times[-1] + steps.max()).any() and answering
        quiet_ns = max(_SHORT_NS, _FACTOR * int(steps.max())) if often else _NEVER
        return _NEVER if self.streamed else min(self.seldom_ns, quiet_ns)

    def _spoke(self, when: int) -> bool:
        """Return whether the observer sent something before a time, and after: heartbeats at least (rule 6).

        It was not there where it sent nothing since, so that its peer's silence then tells nothing.
        """
        before = np.ptp(np.searchsorted(self.said_ns, (when - self.seldom_ns, when)))
        return bool(before and when < self.said_ns[-1])

    def _away(self, start_ns: int, end_ns: int) -> int:
        """Return how much of a span, ns, nothing could be captured."""
        return sum(max(0, min(end, end_ns) - max(start, start_ns)) for start, end in self._outages)

    def _believe(self) -> None:
        """Remove time-outs that the observer did not see (rule 3)."""
        changes, self.changes = self.changes, []
        for at, change in enumerate(changes):
            until = changes[at + 1].time_ns if at + 1 < len(changes) else np.iinfo(np.int64).max
            late = (self.sent_ns > change.time_ns + _STILL_NS) & (self.sent_ns < until - SECOND)
            if change.state == "timed_out" and late.any():
                self.changes[-1] = self.changes[-1]._replace(why=UNSEEN)
            else:
                self.changes.append(change)

    def _add_unseen(self, subscribed: Integers, missing: Integers) -> None:
        """Add time-outs that no silence shows (rule 4).

        Counts are missing from the observer's messages in front of its new SUB: it sent them to nobody.

        Args:
            subscribed: i64, times at which the observer sent SUB, ns.
            missing: i64, number of counts that are missing in front of each message of it but the first.
        """
        behind = np.searchsorted(self.sent_ns, subscribed)
        # Nothing is missing in front of the first message, nor behind the last one.
        lacking = np.concatenate(([0], missing, [0]))[behind] != 0
        for when, later in zip(subscribed[lacking].tolist(), behind[lacking].tolist(), strict=True):
            place = bisect_right(self.changes, when, key=attrgetter("time_ns"))
            last_ns = int(self.sent_ns[later - 1])
            up = place and self.changes[place - 1].state == "connected"
            if up and self.changes[place - 1].time_ns < last_ns < when - _STILL_NS:
                lost = PeerChange(last_ns + 1, "timed_out", "the observer heard nothing of it any more")
                back = PeerChange(when, "connected", "the observer subscribed anew")
                self.changes[place:place] = [lost, back]

    def _find_restarts(self) -> list[PeerRestart]:
        """Return the restarts of the peer (rule 5).

        A bridge that repeats its subscriptions does so after any silence. It counts as restarted only if it
        usually answers messages, and never answered those that were sent to it in the silence.
        """
        times, answers = self.heard_ns, self._answers
        steps = np.diff(times)
        if len(steps) < _LEAST_STEPS or self.streamed:
            return []
        usual_ns = int(np.quantile(steps, 0.95))
        subs = np.flatnonzero(self._kinds == sbn.MsgType.SUB)
        subscribes = times[subs]
        # Subscriptions within a quarter of a second begin together; a bridge repeats them every few seconds.
        begins = int((np.diff(subscribes, prepend=0) > SECOND // 4).sum())
        repeats = begins > 2 + len(self.changes) + (times[-1] - times[0]) // _RARE_NS
        answering = 2 * len(answers) >= len(self.sent_ns)
        # At a peer that answers, missing answers also show a shorter silence.
        long_ns = max(_SHORT_NS // 3, 2 * usual_ns) if answering else max(_SHORT_NS, _FACTOR * usual_ns)
        restarts = []
        for place in np.flatnonzero(steps > long_ns).tolist():
            start_ns, end_ns = times[place : place + 2].tolist()
            followed = any(start_ns <= item.time_ns < end_ns for item in self.changes)
            read_ns = int(answers[answers <= start_ns].max(initial=0)) if answering else start_ns
            unread_ns = read_ns if answering else start_ns + usual_ns
            number = int(np.ptp(np.searchsorted(self.sent_ns, (unread_ns + 1, end_ns))))
            again = subs[slice(*np.searchsorted(subscribes, (end_ns, end_ns + SECOND // 4)))]
            if followed or not number or not len(again):
                continue
            if repeats:
                # Who answers some of what it was sent before had stood still, though its socket kept not all.
                late = self._late_answers(end_ns) > min(_LEAST_ROWS, number // 2)
                if late or not answering or 2 * (len(self.said_ns) - len(answers)) < number:
                    continue
            around = int(self.heard[place]), int(self.heard[again[0]])
            restarts.append(PeerRestart(start_ns, start_ns + usual_ns, end_ns, around, read_ns))
        return restarts

    def _late_answers(self, back_ns: int) -> int:
        """Return how many answers of a peer that is back are to what it had been sent before.

        The network may have kept them for as long as the peer was silent.
        """
        before = np.maximum(np.searchsorted(self.heard_ns, back_ns) - 1, 0)
        until_ns = back_ns + _STILL_NS + back_ns - int(self.heard_ns[before])
        answers = self._answers[slice(*np.searchsorted(self._answers, (back_ns, until_ns)))]
        sent = np.searchsorted(self.said_ns, answers, "right") - np.searchsorted(self.said_ns, back_ns)
        return int((np.arange(1, len(answers) + 1) - sent).max(initial=0))


def _silence(last: int, timeout: int) -> list[PeerChange]:
    return [
        PeerChange(last, "silent", "its last datagram; it was killed, stopped or cut off"),
        PeerChange(last + timeout, "timed_out", f"{timeout // SECOND} s without a word"),
    ]


def _disconnect_spans(said_ns: Integers, kinds: NDArray[np.int16]) -> list[tuple[int, int]]:
    """Return when an observer sent DISCONNECT, and from when on it accepted the peer's datagrams again, ns.

    The second time is shortly before the observer's next datagram to the peer, because it answers; it is the
    largest i64 if there is none.
    """
    goodbye = kinds == sbn.MsgType.DISCONNECT
    others = said_ns[~goodbye]
    spans: list[tuple[int, int]] = []
    for when in said_ns[goodbye].tolist():
        at = int(np.searchsorted(others, when, "right"))
        again = int(others[at]) - 500 * MILLISECOND if at < len(others) else int(np.iinfo(np.int64).max)
        if not spans or when > spans[-1][1]:
            spans.append((when, again))
    return spans


class Network:
    """All peers of the Software Bus Network.

    Attributes:
        identity_of: endpoint to the identity that sends from it.
        connections: (peer, observer) to their connection.
        outages: spans (start, end), ns, in which nothing could be captured.
        timeout_ns: silence after which a cFS gives a peer up.
        seldom_ns: time within which a peer surely sends something, a heartbeat at least.
    """

    def __init__(
        self, rows: Rows, instances: Instances, profile: SimProfile, outages: Sequence[tuple[int, int]] = ()
    ) -> None:
        """Follow every connection.

        Args:
            rows: table of datagrams.
            instances: instances that made them.
            profile: constants of cFS: time-out and heartbeat of SBN.
            outages: spans (start, end), ns, in which nothing could be captured: silence then proves nothing.
        """
        self.identity_of: dict[int, str] = {}
        self.connections: dict[tuple[SbnParty, SbnParty], Connection] = {}
        self.outages = outages
        self._hosts = instances.hosts
        self.timeout_ns = profile.sbn_timeout_s * SECOND
        self.seldom_ns = (profile.sbn_heartbeat_s + 1) * SECOND
        network = np.flatnonzero(rows.on(lambda link: link.peers) & (rows.sbn_msg_type >= 0))
        self._identify(rows, network)
        flight_software = {item.name for item in instances.items if item.name}
        # Cut frames have no mission time, but only a cFS uses sequence counts: bridges never do.
        counting = rows.counted[network] & rows.has(Finding.CAPTURE_CUT, network)
        own = network[(instances.of_row[network] != NOBODY) | counting]
        speakers = {self.identity_of.get(source, "") for source in np.unique(rows.source[own]).tolist()}
        flight_software |= speakers - {""}
        self._connect(rows, network, flight_software)

    def _identify(self, rows: Rows, network: Places) -> None:
        short = rows.has(Finding.TRUNCATED, network) & ~rows.has(Finding.CAPTURE_CUT, network)
        sound = network[~(rows.has(Finding.SBN_UNKNOWN_TYPE, network) | short)]
        for source, own in sorted(groups(rows.source, sound), key=lambda item: -len(item[1])):
            name, number = rows.usual_sender(own)
            # SBN goes by the ids in the header: a peer may send from other ports as well.
            party = name, int(self._hosts[source])
            if number >= _LEAST_ROWS or party in map(self.party, self.identity_of):
                self.identity_of[source] = name

    def party(self, endpoint: int) -> SbnParty:
        """Return the party at an endpoint; the address distinguishes two with one identity."""
        return self.identity_of.get(endpoint, ""), int(self._hosts[endpoint])

    def speaks_from(self, rows: Rows, peer: str, start_ns: int, end_ns: int) -> list[int]:
        """Return the endpoints at which somebody uses an identity between two times."""
        sources = rows.source[slice(*np.searchsorted(rows.time_ns, (start_ns + 1, end_ns)))]
        return [end for end in distinct(sources).tolist() if self.identity_of.get(end) == peer]

    def _connect(self, rows: Rows, network: Places, flight_software: set[str]) -> None:
        parties = [self.party(endpoint) for endpoint in range(len(self._hosts))]
        first, way = numbered(rows.source[network], rows.destination[network])
        source, target = rows.source[network[first]], rows.destination[network[first]]
        ways = by_key(range(len(first)), lambda at: (parties[source[at]], parties[target[at]]))
        for ends in sorted(ways):
            peer, observer = ends
            if peer[0] and observer[0] in flight_software and peer != observer:
                heard, sent = (network[np.isin(way, ways.get(own, []))] for own in (ends, ends[::-1]))
                self.connections[ends] = Connection(ends, rows, heard, sent, self)

    def crossing(self, sender: int, receiver: int) -> Connection | None:
        """Return the receiver's connection as the sender sees it; None if there is none."""
        return self.connections.get((self.party(receiver), self.party(sender)))
