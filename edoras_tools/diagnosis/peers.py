"""The Software Bus Network's connections over time, as each cFS must see them.

A peer is connected from its first datagram on, until it says DISCONNECT or nothing for eleven seconds.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import numpy as np

from edoras_tools.diagnosis.instances import NOBODY
from edoras_tools.model import Finding, Link
from edoras_tools.sessions.profile import MILLISECOND, SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.diagnosis.instances import Instances
    from edoras_tools.diagnosis.payloads import Payloads
    from edoras_tools.diagnosis.table import Rows
    from edoras_tools.sessions.profile import SimProfile

State = Literal["connected", "silent", "timed_out", "disconnected"]
_LEAST_ROWS: Final = 3
_ALREADY_NS: Final = SECOND
_STILL_NS: Final = 3 * SECOND
"""So long after a time-out nobody sends to a peer any more."""
UNSEEN: Final = "nothing of it is seen here since, yet the observer goes on sending to it"


class Change(NamedTuple):
    """A peer's state from a time on."""

    time_ns: int
    state: State
    why: str


@dataclass(slots=True)
class Connection:
    """A peer as one cFS sees it.

    Attributes:
        peer: who is seen, as ``66:3``.
        observer: the cFS that sees it.
        changes: its states, in order.
        sent_ns: capture times of application messages that the observer sent to it.
    """

    peer: str
    observer: str
    changes: list[Change]
    sent_ns: NDArray[np.int64]

    def state_at(self, time_ns: int) -> State | None:
        """Return the state at a time; None before anything was seen."""
        before = [change.state for change in self.changes if change.time_ns <= time_ns]
        return before[-1] if before else None

    def broken_within(self, start_ns: int, end_ns: int) -> bool:
        """Tell whether messages could not cross at some time of a span."""
        if self.state_at(start_ns) != "connected":
            return True
        return any(
            start_ns < change.time_ns <= end_ns and change.state != "silent" for change in self.changes
        )

    def as_json(self) -> dict[str, Any]:
        """Return the connection in the shape of ``doctor --json``."""
        return {
            "peer": self.peer,
            "observer": self.observer,
            "states": [change._asdict() for change in self.changes],
        }


class Network:
    """Everyone on the Software Bus Network.

    Attributes:
        identity_of: endpoint to who speaks from there.
        connections: by (peer, observer).
        datagrams: identity to datagrams sent.
    """

    def __init__(self, rows: Rows, payloads: Payloads, instances: Instances, profile: SimProfile) -> None:
        self.identity_of: dict[int, str] = {}
        self.connections: dict[tuple[str, str], Connection] = {}
        self.datagrams: Counter[str] = Counter()
        self._profile = profile
        self._unsubscribed = [
            (int(rows.time_ns[item.row]), item.wanted)
            for item in payloads.subscriptions
            if rows.sbn_msg_type[item.row] == sbn.MsgType.UNSUB
        ]
        network = np.flatnonzero((rows.link == Link.SBN) & (rows.sbn_msg_type >= 0))
        if not len(network):
            return
        self._identify(rows, network)
        flight_software = {item.name for item in instances.items if item.name}
        timed = network[instances.of_row[network] != NOBODY]
        speakers = {self.identity_of.get(source, "") for source in np.unique(rows.source[timed]).tolist()}
        flight_software |= speakers - {""}
        self._connect(rows, network, flight_software)

    def _identify(self, rows: Rows, network: NDArray[np.intp]) -> None:
        sound = network[~rows.has(Finding.SBN_UNKNOWN_TYPE | Finding.TRUNCATED)[network]]
        for source in np.unique(rows.source[sound]).tolist():
            own = sound[rows.source[sound] == source]
            who = rows.spacecraft_id[own].astype(np.uint64) << 32 | rows.processor_id[own]
            values, counts = np.unique(who, return_counts=True)
            most = int(values[counts.argmax()])
            name = f"{most >> 32}:{most & 0xFFFFFFFF}"
            if counts.max() >= _LEAST_ROWS:
                self.identity_of[source] = name
            self.datagrams[name] += int(counts.max())

    def _connect(self, rows: Rows, network: NDArray[np.intp], flight_software: set[str]) -> None:
        source = np.array([self.identity_of.get(item, "") for item in rows.source[network].tolist()])
        target = np.array([self.identity_of.get(item, "") for item in rows.destination[network].tolist()])
        end_ns = int(rows.time_ns[-1])
        for peer in sorted(set(source.tolist()) - {""}):
            for observer in sorted(flight_software - {peer}):
                heard = network[(source == peer) & (target == observer)]
                sent = network[(source == observer) & (target == peer)]
                if not len(heard):
                    continue
                said = sent if len(sent) else heard
                app = sent[rows.sbn_msg_type[sent] == sbn.MsgType.APP]
                changes = self._changes(rows, heard, int(rows.time_ns[said[0]]), end_ns)
                changes = _believed(changes, rows.time_ns[app])
                self.connections[peer, observer] = Connection(peer, observer, changes, rows.time_ns[app])

    def _changes(self, rows: Rows, heard: NDArray[np.intp], alive_ns: int, end_ns: int) -> list[Change]:
        """Follow one peer's datagrams to one observer, who is there from ``alive_ns`` on."""
        timeout = self._profile.sbn_timeout_s * SECOND
        silent = (self._profile.sbn_heartbeat_s + 1) * SECOND
        begin_ns = int(rows.time_ns[0])
        changes: list[Change] = []
        up, last = False, 0
        for row in heard.tolist():
            now, kind = int(rows.time_ns[row]), int(rows.sbn_msg_type[row])
            # What came before the observer was there, nobody heard.
            if now < alive_ns - 500 * MILLISECOND:
                continue
            if up and now - last >= timeout:
                changes += self._silence(last, timeout)
                up = False
            if kind == sbn.MsgType.DISCONNECT:
                if up:
                    changes.append(Change(now, "disconnected", "it sent DISCONNECT"))
                up = False
            elif not up:
                first = not changes and now - begin_ns < _ALREADY_NS
                why = "it was when the capture began" if first else f"its {_name(kind)} arrived"
                changes.append(Change(now, "connected", why))
                up = True
            last = now
        if up and end_ns - last >= timeout + SECOND:
            changes += self._silence(last, timeout)
        elif up and end_ns - last >= silent:
            text = f"nothing from it since, {(end_ns - last) / SECOND:.1f} s to the end of the capture"
            changes.append(Change(last, "silent", text))
        return changes

    @staticmethod
    def _silence(last: int, timeout: int) -> list[Change]:
        return [
            Change(last, "silent", "its last datagram; it was killed, stopped or cut off"),
            Change(last + timeout, "timed_out", f"{timeout // SECOND} s without a word"),
        ]

    def crossing(self, sender: int, receiver: int) -> Connection | None:
        """Return the receiving peer's connection, as the sending cFS sees it."""
        return self.connections.get((self.identity_of.get(receiver, ""), self.identity_of.get(sender, "")))

    def unsubscribed_within(self, msg_id: int, start_ns: int, end_ns: int) -> bool:
        """Tell whether a MsgId was unsubscribed in a span of time."""
        return any(start_ns <= when <= end_ns and msg_id in wanted for when, wanted in self._unsubscribed)


def _believed(changes: list[Change], sent_ns: NDArray[np.int64]) -> list[Change]:
    """Take back time-outs that the observer did not see: it went on sending, so the peer was heard there."""
    out: list[Change] = []
    for at, change in enumerate(changes):
        until = changes[at + 1].time_ns if at + 1 < len(changes) else np.iinfo(np.int64).max
        late = (sent_ns > change.time_ns + _STILL_NS) & (sent_ns < until)
        if change.state == "timed_out" and late.any():
            out[-1] = out[-1]._replace(why=UNSEEN)
            continue
        out.append(change)
    return out


def _name(kind: int) -> str:
    return sbn.MSG_TYPE_NAMES.get(kind, f"type 0x{kind:02x}")
