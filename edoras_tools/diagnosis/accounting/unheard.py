"""What cFS sent to an SBN peer that had fallen silent: it crossed the capture, and nobody heard it.

A peer that cFS gave up for its silence heard nothing since its last datagram: what was sent to it is lost.
One that is silent when the capture ends may be there or not: what was sent since is unaccounted for.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from edoras_tools.diagnosis.accounting.losses import Known


@dataclass(slots=True)
class Unheard:
    """Messages of one stream that were sent to a silent peer.

    Attributes:
        peer: who, as ``66:3``.
        lost: how many, to one that was given up.
        unaccounted: how many, to one that was silent when the capture ended.
        rows: those that are lost, as indices into the stream's rows.
    """

    peer: str
    lost: int = 0
    unaccounted: int = 0
    rows: list[int] = field(default_factory=list)


def unheard(known: Known) -> dict[int, Unheard]:
    """Return it by the id of the stream; a stream is there if its peer was silent at all."""
    found: dict[int, Unheard] = {}
    party = known.network.party
    for (peer, observer), connection in known.network.connections.items():
        silences = list(connection.silences(known.end_ns))
        for stream in known.streams:
            ends = party(stream.receiver), party(stream.sender)
            if not silences or not stream.link.peers or ends != (peer, observer):
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
    return found
