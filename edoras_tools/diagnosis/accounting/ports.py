"""What was sent to ports that nobody listened on, or that could not be reached, by ICMP errors.

1. A telemetry packet that went there is lost behind cFS; a command is lost behind the application if all that
   came of it on its way to one robot went there.
2. A peer of the Software Bus Network is silent while its port is closed: what its silence tells is not told
   again.
3. What went to a robot and is of no command of the capture has a row of its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.matching.streams import find_robots
from edoras_tools.wire.arrays.order import by_value

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.closed import Unheard
    from edoras_tools.diagnosis.accounting.fates import Fate
    from edoras_tools.diagnosis.accounting.losses import Known, LossKind
    from edoras_tools.diagnosis.evidence.unreachable import Unreachable
    from edoras_tools.diagnosis.matching.streams import Stream

UDP_PORT: Final = "port"
PORT_CLOSED: Final[LossKind] = "port_closed"
REFUSED: Final = "unreachable"
"""Causes of a loss, which are the rules that tell of them."""
_FINE, _UNCERTAIN, _REFUSED, _CLOSED = range(4)
_CAUSES: Final = {_CLOSED: PORT_CLOSED, _REFUSED: REFUSED}


@dataclass(frozen=True, slots=True)
class Unreached:
    """Messages of one stream that went to one endpoint that did not get all of them.

    Attributes:
        stream: of telemetry, of commands to cFS, or of what a robot was sent.
        endpoint: number of the endpoint.
        own: whether the stream stands in the balance by itself; else it is of no command of the capture.
        lost: cause to those that are lost, as indices into the stream's rows.
        uncertain: those that may be, likewise.
        sent_ns: i64, when each of the stream's messages went to the endpoint.
    """

    stream: Stream
    endpoint: int
    own: bool
    lost: Mapping[str, NDArray[np.intp]]
    uncertain: NDArray[np.intp]
    sent_ns: NDArray[np.int64]

    @property
    def number(self) -> int:
        """How many are lost."""
        return sum(len(rows) for rows in self.lost.values())


def unreached(
    known: Known, found: Unreachable, fates: Mapping[int, Fate], unheard: Mapping[int, Unheard]
) -> list[Unreached]:
    """Return it by stream, in the order of the streams.

    Args:
        fates: id of a stream to what became of its messages.
        unheard: id of a stream to what silent SBN peers did not hear.
    """
    fate_of = np.zeros(len(known.rows), np.int8)
    for mark, mask in ((_UNCERTAIN, found.uncertain), (_REFUSED, found.refused), (_CLOSED, found.closed)):
        fate_of[mask] = mark
    if not fate_of.any():
        return []
    out: list[Unreached] = []
    covered = np.zeros(len(known.rows), bool)
    times = known.rows.time_ns
    for stream in known.streams:
        fate = fates.get(id(stream))
        for hop in fate.hops if fate else ():
            if hop.out.link.last_hop:
                rows = hop.out.rows[hop.out_rows]
                covered[rows] = True
                best, sent_ns = np.full(len(stream), _CLOSED, np.int8), np.zeros(len(stream), np.int64)
                np.minimum.at(best, hop.in_rows, fate_of[rows])
                np.maximum.at(sent_ns, hop.in_rows, times[rows])
                every = np.unique(hop.in_rows)
                out += _parts(stream, every, best, hop.out.receiver, sent_ns, own=True)
        if fate is None and id(stream) not in unheard:
            for endpoint, rows in by_value(known.rows.destination[stream.rows]):
                out += _parts(stream, rows, fate_of[stream.rows], endpoint, times[stream.rows], own=True)
    for stream in find_robots(known.rows):
        rows = np.flatnonzero(~covered[stream.rows])
        sent_ns = times[stream.rows]
        out += _parts(stream, rows, fate_of[stream.rows], stream.receiver, sent_ns, own=False)
    return out


def _parts(
    stream: Stream,
    rows: NDArray[np.intp],
    fate_of: NDArray[np.int8],
    endpoint: int,
    sent_ns: NDArray[np.int64],
    *,
    own: bool,
) -> Iterator[Unreached]:
    """Yield what some rows of a stream lost at an endpoint, if anything."""
    lost = {cause: rows[fate_of[rows] == mark] for mark, cause in _CAUSES.items()}
    uncertain = rows[fate_of[rows] == _UNCERTAIN]
    if len(uncertain) or any(map(len, lost.values())):
        found = {cause: at for cause, at in lost.items() if len(at)}
        yield Unreached(stream, endpoint, own, found, uncertain, sent_ns)
