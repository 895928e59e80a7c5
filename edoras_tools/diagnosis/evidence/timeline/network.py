"""State changes that the traffic of the Software Bus Network shows: peers, and what each is subscribed to.

1. A peer is connected, silent, timed out or disconnected as :class:`Network` follows it, and silent, too,
   from its last datagram to its restart where nobody gave it up.
2. A peer is subscribed to what its SUBs of this connection name. A connection that ends, ends them all; what
   the peer does not ask for again it does not get.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.evidence.peers import ALREADY
from edoras_tools.diagnosis.evidence.timeline.table import EVERY, Change, StateOwner
from edoras_tools.units import SECOND
from edoras_tools.wire import sbn

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.evidence.instances import Instances
    from edoras_tools.diagnosis.evidence.payloads import Payloads
    from edoras_tools.diagnosis.evidence.peers import Connection, Network, SbnParty
    from edoras_tools.diagnosis.evidence.table import Rows

_WAKE_NS: Final = SECOND


def network_changes(
    rows: Rows, payloads: Payloads, instances: Instances, network: Network
) -> Iterator[Change]:
    """Yield the changes of every peer, as each cFS sees it."""
    listed = payloads.subscriptions
    at, contents = listed["row"], listed["said"]
    for (peer, observer), connection in network.connections.items():
        system = _system(instances, observer)
        yield from _peer(connection, system, int(rows.time_ns[0]))
        own = _between(rows, network, at, peer, observer)
        yield from _subscriptions(rows, at[own], contents[own], payloads, connection, system)


def capture_changes(away: Sequence[tuple[int, int]]) -> Iterator[Change]:
    """Yield when nothing could be captured, and when it could again."""
    for start_ns, end_ns in away:
        for state, when in (("away", start_ns), ("back", end_ns)):
            yield Change(EVERY, StateOwner("capture"), state, when, when, "nothing was captured meanwhile")


def _system(instances: Instances, observer: SbnParty) -> int:
    name, host = observer
    fits = [
        system
        for item, system in zip(instances.items, instances.systems, strict=True)
        if item.name == name and item.host == host
    ]
    return fits[0] if fits else 0


def _between(
    rows: Rows, network: Network, at: NDArray[np.int64], peer: SbnParty, observer: SbnParty
) -> NDArray[np.bool_]:
    """Tell which rows one party sent to another."""
    ends = []
    for party, column in ((peer, rows.source), (observer, rows.destination)):
        places = [place for place in np.unique(column[at]).tolist() if network.party(place) == party]
        ends.append(np.isin(column[at], places))
    return np.asarray(ends[0] & ends[1])


def _peer(connection: Connection, system: int, begin_ns: int) -> Iterator[Change]:
    """Yield the states of a peer."""
    subject = StateOwner("peer", connection.peer)
    if connection.changes and connection.changes[0].why != ALREADY:
        yield Change(system, subject, "disconnected", begin_ns, begin_ns, "nothing came from it before")
    for item in connection.changes:
        yield Change(system, subject, item.state, item.time_ns, item.time_ns + _WAKE_NS, item.why)
    for last_ns, dead_ns, back_ns, (last, first) in connection.restarts:
        text = f"nothing from it for {(back_ns - last_ns) / SECOND:.1f} s, then it subscribed anew"
        yield Change(system, subject, "silent", last_ns, dead_ns, text, (last,))
        yield Change(system, subject, "connected", back_ns, back_ns, "it subscribed anew", (first,))


def _subscriptions(
    rows: Rows,
    at: NDArray[np.int64],
    contents: NDArray[np.int64],
    payloads: Payloads,
    connection: Connection,
    system: int,
) -> Iterator[Change]:
    peer = connection.peer
    ends = [item for item in connection.changes if item.state in {"timed_out", "disconnected"}]
    begins = [item for item in connection.changes if item.state == "connected" and item.why != ALREADY]
    edges = np.array([item.time_ns for item in ends], np.int64)
    session = np.searchsorted(edges, rows.time_ns[at])
    unsubscribed = rows.sbn_msg_type[at] == sbn.MsgType.UNSUB
    # A bridge says the same twice a second: of each connection the first of each content tells, unless one of
    # them takes back what others asked for.
    key = np.stack((session, contents)) if len(at) else np.zeros((2, 0), np.int64)
    first = np.sort(np.unique(key, axis=1, return_index=True)[1])
    chosen = np.arange(len(at)) if unsubscribed.any() else first
    asked: dict[int, set[int]] = {}
    for place in chosen.tolist():
        row, ended = int(at[place]), bool(unsubscribed[place])
        now = int(rows.time_ns[row])
        verb, state = ("UNSUB", "unsubscribed") if ended else ("SUB", "subscribed")
        for msg_id in payloads.contents[int(contents[place])].wanted:
            members = asked.setdefault(int(session[place]), set())
            if ended or msg_id not in members:
                (members.discard if ended else members.add)(msg_id)
                subject = StateOwner("subscription", peer, msg_id)
                begun = [item for item in begins if item.time_ns <= now]
                if begun and not ended and now > begun[-1].time_ns + _WAKE_NS:
                    since = begun[-1].time_ns
                    text = f"{peer} was connected and had not subscribed to it"
                    yield Change(system, subject, "unsubscribed", since, since + _WAKE_NS, text)
                text = f"{verb} of {peer} for 0x{msg_id:04x}"
                yield Change(system, subject, state, now, now + _WAKE_NS, text, (row,))
    for number, item in enumerate(ends):
        for msg_id in asked.get(number, ()):
            subject = StateOwner("subscription", peer, msg_id)
            text = f"its connection ended: {item.why}"
            yield Change(system, subject, "unsubscribed", item.time_ns, item.time_ns + _WAKE_NS, text)
