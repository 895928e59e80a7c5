"""Which link a datagram belongs to: by the mission's endpoints, then by port and content.

On the demos' single host cpu2's CI port equals TO's destination port (both 1235): a port alone does not tell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.model import Finding, Link
from edoras_tools.wire import ccsds

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.decode.context import Context
    from edoras_tools.model import Datagram, PacketBatch

_TYPE_BIT: Final = ccsds.TELECOMMAND << 4
_CI, _TO, _SBN = (1 << link for link in (Link.CI, Link.TO, Link.SBN))


def settle(claims: int, sender_claims: int, *, command: bool, to_cfs: bool, from_cfs: bool) -> Link:
    """Choose the link of a datagram.

    Args:
        claims: bit ``1 << link`` for every link that the destination port may belong to.
        sender_claims: the same of the source port.
        command: the first byte has the CCSDS type bit, or there is none: TO never sends an empty datagram.
        to_cfs: the destination is a cFS that the mission names.
        from_cfs: the source is one.
    """
    if claims & _SBN:
        return Link.SBN
    if claims & _CI and claims & _TO:
        ingest = to_cfs if to_cfs != from_cfs else command
        return Link.CI if ingest else Link.TO
    if claims & _CI:
        return Link.CI
    if claims & _TO:
        return Link.TO
    return Link.SBN if sender_claims & _SBN else Link.OTHER


_TABLE: Final = np.array(
    [
        settle(
            index & 0b1110,
            _SBN * (index & 1),
            command=bool(index & 16),
            to_cfs=bool(index & 32),
            from_cfs=bool(index & 64),
        )
        for index in range(128)
    ],
    np.uint8,
)


def link_columns(batch: PacketBatch, context: Context) -> NDArray[np.uint8]:
    """Return the link of every datagram of a batch, u8 (n,). Fragments without a payload belong to none."""
    empty = batch.length <= 0
    first = (
        batch.data[np.minimum(batch.offset, max(len(batch.data) - 1, 0))] if len(batch.data) else np.uint8(0)
    )
    ipv4 = batch.ip_version == 4
    index = (
        context.port_links[batch.destination_port]
        | (context.port_links[batch.source_port] & _SBN) >> Link.SBN
    )
    index |= (((first & _TYPE_BIT) != 0) | empty) * np.uint8(16)
    for address in context.cfs_addresses:
        index |= (ipv4 & (batch.destination_address == address)) * np.uint8(32)
        index |= (ipv4 & (batch.source_address == address)) * np.uint8(64)
    link: NDArray[np.uint8] = _TABLE[index]
    link[(batch.capture_findings & Finding.FRAGMENT) != 0] = Link.OTHER
    return link


def link_of(datagram: Datagram, context: Context) -> Link:
    """Return the link of one datagram: the same answer as :func:`link_columns`."""
    if Finding.FRAGMENT in datagram.findings:
        return Link.OTHER
    return settle(
        int(context.port_links[datagram.destination.port]),
        int(context.port_links[datagram.source.port]),
        command=not datagram.payload or bool(datagram.payload[0] & _TYPE_BIT),
        to_cfs=context.is_cfs(datagram.destination),
        from_cfs=context.is_cfs(datagram.source),
    )
