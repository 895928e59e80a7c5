"""What cFS sent where nobody heard it: ways out of a telemetry stream that were closed, and silent SBN peers.

1. What is missing while the way out of a stream was closed was not sent.
2. A peer that cFS gave up for its silence heard nothing since its last datagram: what was sent to it is lost.
3. One that was started again before that heard nothing from when it would have sent next until it subscribed
   anew; what it was sent just before may have been heard.
4. One that is silent when the capture ends may be there or not: what was sent since is unaccounted for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.cfs import sbn, telemetry_output
from edoras_tools.diagnosis.evidence.instances import NOBODY
from edoras_tools.diagnosis.evidence.timeline.table import StateOwner
from edoras_tools.links.table import among
from edoras_tools.model import NO_MSG_ID
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.losses import Known
    from edoras_tools.diagnosis.matching.streams import Stream


_SILENT_WAKES: Final = 5
_STOPS_NS: Final = 3 * SECOND
"""After a command that stops them, packets come for so long, also over a slow network."""


def closed_at(known: Known, stream: Stream, at: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Tell which gaps of a stream span a time in which its way out was closed."""
    rows = known.rows
    behind = np.minimum(at + 1, len(stream) - 1)
    starts, ends = rows.time_ns[stream.rows[at]], rows.time_ns[stream.rows[behind]]
    out = np.zeros(len(at), bool)
    if stream.link.only_from_cfs:
        # Telemetry Output that speaks from another port started anew, and forgot whom it sends to.
        out |= rows.source[stream.rows[at]] != rows.source[stream.rows[behind]]
        for item in known.payloads.output:
            when = int(rows.time_ns[item.row])
            if item.function_code in telemetry_output.STOPS and item.msg_id in {-1, stream.msg_id}:
                out |= (starts - _STOPS_NS < when) & (when < ends)
        return out
    connection = known.network.crossing(stream.sender, stream.receiver)
    owner = known.owner(stream)
    system = known.instances.systems[owner] if owner != NOBODY else 0
    stopped = known.timeline.spans(StateOwner("app", sbn.NAME), "stopped", system)
    for index, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
        out[index] = bool(
            (connection and connection.broken_within(start, end))
            or known.network.unsubscribed_within(stream.msg_id, start - _STOPS_NS, end)
            or any(span.overlaps(start, end) for span in stopped)
        )
    return out


def silenced_at(
    known: Known, stream: Stream, at: NDArray[np.intp], spans: Sequence[tuple[int, int]]
) -> NDArray[np.bool_]:
    """Tell which gaps of a stream span a time in which Telemetry Output sent nothing until it was enabled."""
    times, behind = known.captured(stream), np.minimum(at + 1, len(stream) - 1)
    out = np.zeros(len(at), bool)
    for start_ns, end_ns in spans:
        out |= (times[at] <= start_ns) & (times[behind] >= end_ns)
    return out


def one_sided(known: Known, stream: Stream) -> bool:
    """Tell whether nothing was captured of what tells cFS whether to send a stream.

    Telemetry Output does what commands to cFS tell it, SBN sends to a peer that is connected.
    """
    rows = known.rows
    if stream.link.peers:
        return not ((rows.source == stream.receiver) & (rows.destination == stream.sender)).any()
    return not among(rows.link, lambda link: link.only_to_cfs).any()


def unled_silences(known: Known, stream: Stream) -> list[tuple[int, int]]:
    """Return when nothing at all came on a stream's way, where nothing tells whether it was to be sent."""
    if not one_sided(known, stream):
        return []
    if stream.link.peers:
        rows = known.rows
        there = (rows.source == stream.sender) & (rows.destination == stream.receiver)
        times = rows.time_ns[there & (rows.msg_id != NO_MSG_ID)]
    else:
        times = _sent_by(known, stream.sender)
    silent = np.flatnonzero(np.diff(times) > _SILENT_WAKES * known.profile.to_wake_ns)
    return [(int(times[at]), int(times[at + 1])) for at in silent.tolist()]


def _sent_by(known: Known, sender: int) -> NDArray[np.int64]:
    """Return when the Telemetry Output behind an endpoint sent something."""
    rows, output = known.rows, known.instances.output
    sent = among(rows.link, lambda link: link.only_from_cfs)
    mine = [port for port in np.unique(rows.source[sent]).tolist() if sender in {port, output(port)}]
    times: NDArray[np.int64] = rows.time_ns[sent & np.isin(rows.source, mine)]
    return times


def silences_of(known: Known, sender: int) -> list[tuple[int, int]]:
    """Return when the Telemetry Output behind an endpoint sent nothing, until it was enabled."""
    rows = known.rows
    enabled = [
        int(rows.time_ns[item.row])
        for item in known.payloads.output
        if item.function_code == telemetry_output.ENABLE
    ]
    sent_ns = _sent_by(known, sender)
    owner = known.instances.owner(sender, int(sent_ns[0]))
    boot_ns = None
    if owner != NOBODY:  # since it began, or the capture did
        boot_ns = known.instances.items[owner].boot_ns(known.profile)
        sent_ns = np.append(max(boot_ns, int(rows.time_ns[0])), sent_ns)
    return silences(sent_ns, enabled, known.profile.to_wake_ns, boot_ns)


def silences(
    sent_ns: NDArray[np.int64], enabled_ns: Sequence[int], wake_ns: int, boot_ns: int | None = None
) -> list[tuple[int, int]]:
    """Return when a Telemetry Output sent nothing, until it was enabled: between which two of its packets.

    It is silent for longer than it ever waits, and one command that enables it comes just before it goes on:
    commands that come all the time tell nothing.

    Args:
        sent_ns: when it sent, in order.
        enabled_ns: when commands were sent that enable it.
        boot_ns: it began then, and is silent from then on; as the first of the times where it is one.
    """
    found = []
    most_ns = np.full(len(sent_ns), _SILENT_WAKES * wake_ns)[1:]
    most_ns[:1][sent_ns[:1] == boot_ns] = wake_ns
    for at in np.flatnonzero(np.diff(sent_ns) > most_ns).tolist():
        start_ns, end_ns = int(sent_ns[at]), int(sent_ns[at + 1])
        inside = [when for when in enabled_ns if start_ns < when < end_ns]
        if inside and min(inside) > end_ns - _SILENT_WAKES * wake_ns:
            found.append((start_ns, end_ns))
    return found


@dataclass(slots=True)
class Unheard:
    """Messages of one stream that were sent to a silent peer.

    Attributes:
        peer: who, as ``66:3``.
        lost: how many, to one that was given up.
        restarted: how many, to one that was started again before it was given up.
        uncertain: how many, when that one may still have run.
        unaccounted: how many, to one that was silent when the capture ended.
        rows: those to one that was given up, as indices into the stream's rows.
        restarted_rows: those to one that was started again, likewise.
    """

    peer: str
    lost: int = 0
    restarted: int = 0
    uncertain: int = 0
    unaccounted: int = 0
    rows: list[int] = field(default_factory=list)
    restarted_rows: list[int] = field(default_factory=list)


def unheard(known: Known) -> dict[int, Unheard]:
    """Return it by the id of the stream; a stream is there if its peer was silent at all."""
    found: dict[int, Unheard] = {}
    party = known.network.party
    for (peer, observer), connection in known.network.connections.items():
        silences = list(connection.silences(known.end_ns))
        for stream in known.streams:
            ends = party(stream.receiver), party(stream.sender)
            none = not silences and not connection.restarts
            if none or not stream.link.peers or ends != (peer, observer):
                continue
            item = found.setdefault(id(stream), Unheard(connection.peer))
            times = known.captured(stream)
            for silence in silences:
                inside = np.flatnonzero((times > silence.start_ns) & (times < silence.until_ns)).tolist()
                if silence.given_up:
                    item.lost += len(inside)
                    item.rows += inside
                else:
                    item.unaccounted += len(inside)
            for restart in connection.restarts:
                gone = np.flatnonzero((times > restart.dead_ns) & (times < restart.back_ns)).tolist()
                item.restarted += len(gone)
                item.restarted_rows += gone
                item.uncertain += int(((times > restart.last_ns) & (times <= restart.dead_ns)).sum())
    return found
