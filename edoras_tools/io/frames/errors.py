"""ICMP errors that quote a UDP datagram, found in frames: see :mod:`edoras_tools.wire.icmp`."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.io.frames.network import IpPayloads, transport_payloads
from edoras_tools.wire.arrays.window import gather
from edoras_tools.wire.icmp import FORMS, LONGEST, QUOTED_UDP

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.model import PacketBatch
    from edoras_tools.wire.layout import Layout

_PROTOCOLS: Final = FORMS[0].protocol, FORMS[1].protocol


def find_errors(
    data: NDArray[np.uint8],
    network: NDArray[np.int64],
    version: NDArray[np.uint8],
    end: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> IpPayloads | None:
    """Return the errors among some frames of ICMP, by the place of the frame; None where there is none.

    Args:
        data: u8, the buffer.
        network: i64, start of each frame's IP header.
        version: u8, 4 or 6.
        end: i64, one past each frame's last captured byte.
        rows: i64, the frames that may be errors.
    """
    least = min(form.size for form in FORMS)
    payloads = transport_payloads(data, network[rows], version[rows], end[rows], _PROTOCOLS, least)
    assert payloads.rows is not None
    window = gather(data, payloads.position, LONGEST)
    have = np.minimum(payloads.end, end[rows][payloads.rows]) - payloads.position

    def field(layout: Layout, name: str, at: int) -> NDArray[Any]:
        values = layout.column(name, window, at).astype(np.int64)
        return np.where(have >= at + layout.by_name[name].end, values, -1)

    fits = np.zeros(len(have), bool)
    for form in FORMS:
        fits |= (payloads.version == form.version) & form.fits(field)
    if not fits.any():
        return None
    payloads = payloads.take(fits)
    assert payloads.rows is not None
    return replace(payloads, rows=rows[payloads.rows])


def error_rows(batch: PacketBatch) -> NDArray[np.bool_]:
    """Tell which rows of a batch are errors: only they have no ports."""
    return np.asarray((batch.source_port == 0) & (batch.destination_port == 0))


def quoted_ports(batch: PacketBatch, rows: NDArray[np.intp]) -> NDArray[np.uint16]:
    """Return the source and destination port that errors quote, u16 (n, 2).

    Args:
        rows: those of the errors.
    """
    start = np.array([form.start(QUOTED_UDP) for form in FORMS])
    at = batch.offset[rows] + start[(batch.ip_version[rows] == FORMS[1].version).astype(np.intp)]
    return gather(batch.data, at, 4).view(">u2").astype(np.uint16)
