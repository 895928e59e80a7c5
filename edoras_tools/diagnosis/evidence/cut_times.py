"""Packet times that are cut off on one link, taken from the same packet on another link.

SBN puts 11 bytes in front of a packet, so that a cut frame shows less of it than one of Telemetry Output,
which forwards what arrives over SBN. A packet on both links has one MsgId, one sequence count and one time.
Without the time, two cFS, or two boots of one cFS, cannot be distinguished.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.evidence.fingerprint import latest_equal
from edoras_tools.diagnosis.evidence.table import Rows, followed
from edoras_tools.links.table import among
from edoras_tools.model import Finding
from edoras_tools.units import SECOND
from edoras_tools.wire.msg_id import VERSION_1

if TYPE_CHECKING:
    from numpy.typing import NDArray


HANDED_ON_NS: Final = 2 * SECOND
"""Telemetry Output hands on what came over SBN within so long."""


def with_cut_times(rows: Rows) -> Rows:
    """Return rows in which packets on SBN have the times that Telemetry Output shows of the same packets."""
    bare = rows.has(Finding.CAPTURE_CUT) & (rows.mission_time_ns <= 0) & rows.counted
    bare &= ~VERSION_1.is_command(rows.known_id)
    network = np.flatnonzero(bare & among(rows.link, lambda link: link.peers))
    output = np.flatnonzero(
        among(rows.link, lambda link: link.only_from_cfs) & rows.counted & (rows.mission_time_ns > 0)
    )
    if not len(network) or not len(output):
        return rows
    from_ = handed_on(rows, network, output)
    there = from_ >= 0
    into, told = network[from_[there]], rows.mission_time_ns[output[there]]
    least, most = np.full(len(rows), np.iinfo(np.int64).max), np.zeros(len(rows), np.int64)
    np.minimum.at(least, into, told)
    np.maximum.at(most, into, told)
    into = np.unique(into)
    sure = least[into] == most[into]
    # Two cFS that were started together give one count at one time: then it tells nothing.
    sender = rows.spacecraft_id.astype(np.uint64) << 32 | rows.processor_id
    for who in np.unique(sender[into]).tolist():
        own = sender[into] == who
        if 2 * sure[own].sum() < own.sum():
            sure[own] = False
    if not sure.any():
        return rows
    times = rows.mission_time_ns.copy()
    times[into[sure]] = least[into[sure]]
    return followed(replace(rows, mission_time_ns=times))


def handed_on(rows: Rows, network: NDArray[np.intp], output: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return which row of SBN each row of Telemetry Output is, as its place in ``network``; -1 for none.

    They are equal in all bytes; where frames are cut, as different parts of a packet are left of it then, in
    MsgId and sequence count.
    """
    prints = rows.packet_print
    if rows.has(Finding.CAPTURE_CUT)[np.concatenate((network, output))].any():
        count = (rows.msg_id.astype(np.uint64) << np.uint64(14)) + rows.sequence_count + np.uint64(1)
        prints = np.where(rows.counted, count, 0)
    from_ = latest_equal(prints[network], rows.time_ns[network], prints[output], rows.time_ns[output])
    late = from_ >= 0
    late[late] = rows.time_ns[output[late]] - rows.time_ns[network[from_[late]]] >= HANDED_ON_NS
    return np.where(late, -1, from_)
