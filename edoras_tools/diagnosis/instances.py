"""Which cFS instance made a telemetry packet: instances on one host share addresses, never a boot time.

Capture time minus mission time is the same for all packets of one boot, but for the delay on the way (a
second or so). Offsets further apart than that are different boots, or a clock that was set.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.fingerprint import latest_equal
from edoras_tools.model import Link
from edoras_tools.sessions.profile import SECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.payloads import EventRecord
    from edoras_tools.diagnosis.table import Rows

_APART_NS: Final = 3 * SECOND
"""No packet is delayed so long on its way; no two boots are told apart that are closer."""
_LEAST_ROWS: Final = 3
NOBODY: Final = -1


@dataclass(frozen=True, slots=True)
class Instance:
    """One boot of one cFS.

    Attributes:
        name: its spacecraft and processor, as ``66:1``; empty where nothing in the capture says.
        offset_ns: capture time minus mission time, less the shortest delay.
        first_ns: its first packet here.
        last_ns: its last packet here.
    """

    name: str
    offset_ns: int
    first_ns: int
    last_ns: int

    @property
    def label(self) -> str:
        """How people are told of it."""
        return f"cFS {self.name}" if self.name else "cFS"


class Instances:
    """The instances of a capture.

    Attributes:
        items: them, by offset.
        of_row: i32, the instance that made each row's packet; ``NOBODY`` where the packet has no time.
    """

    def __init__(self, rows: Rows, events: Sequence[EventRecord]) -> None:
        self.of_row = np.full(len(rows), NOBODY, np.int32)
        self.items: list[Instance] = []
        timed = np.flatnonzero(
            (rows.mission_time_ns > 0) & ((rows.link == Link.TO) | (rows.link == Link.SBN))
        )
        offset = rows.time_ns[timed] - rows.mission_time_ns[timed]
        order = np.argsort(offset, kind="stable")
        cuts = np.flatnonzero(np.diff(offset[order]) > _APART_NS) + 1
        says = {event.row: event.sender for event in events}
        for part in np.split(order, cuts):
            for members in _publishers(rows, timed[part], says):
                if len(members) >= _LEAST_ROWS:
                    self._add(rows, members, says)
        self._owners = self._find_owners(rows)

    def _add(self, rows: Rows, members: NDArray[np.intp], says: dict[int, str]) -> None:
        self.of_row[members] = len(self.items)
        times = rows.time_ns[members]
        offset = int((times - rows.mission_time_ns[members]).min())
        name = self._name(rows, members, says)
        self.items.append(Instance(name, offset, int(times.min()), int(times.max())))

    @staticmethod
    def _name(rows: Rows, members: NDArray[np.intp], says: dict[int, str]) -> str:
        """Return who an instance says that it is: in its events, else as SBN sender."""
        events = members[rows.msg_id[members] == cfe.EVENT_MSG_ID]
        told = Counter(says[row] for row in events.tolist() if row in says)
        if told:
            return told.most_common(1)[0][0]
        network = members[rows.link[members] == Link.SBN]
        if not len(network):
            return ""
        sender = rows.spacecraft_id[network].astype(np.uint64) << 32 | rows.processor_id[network]
        values, counts = np.unique(sender, return_counts=True)
        most = int(values[counts.argmax()])
        return f"{most >> 32}:{most & 0xFFFFFFFF}"

    def _find_owners(self, rows: Rows) -> dict[int, list[tuple[int, int]]]:
        """Find whose socket telemetry leaves by: events never come from another instance."""
        owners: dict[int, list[tuple[int, int]]] = {}
        telemetry = (rows.link == Link.TO) & (self.of_row != NOBODY)
        for source in np.unique(rows.source[telemetry]).tolist():
            own = telemetry & (rows.source == source)
            said = own & (rows.msg_id == cfe.EVENT_MSG_ID)
            found = self.of_row[said if said.any() else own]
            values, first, counts = np.unique(found, return_index=True, return_counts=True)
            if said.any():
                times = rows.time_ns[np.flatnonzero(said)[first]]
                owners[source] = sorted(zip(times.tolist(), values.tolist(), strict=True))
            else:
                owners[source] = [(0, int(values[counts.argmax()]))]
        return owners

    def owner(self, source: int, time_ns: int) -> int:
        """Return whose Telemetry Output sends from an endpoint at a time; ``NOBODY`` where unknown."""
        known = self._owners.get(source, [])
        before = [index for since, index in known if since <= time_ns]
        return before[-1] if before else known[0][1] if known else NOBODY

    def named(self, name: str, time_ns: int) -> int:
        """Return the instance of a name that was there at a time; the nearest where none was."""
        fits = [index for index, item in enumerate(self.items) if item.name == name]
        if not fits:
            return NOBODY

        def away(index: int) -> int:
            item = self.items[index]
            return max(item.first_ns - time_ns, time_ns - item.last_ns, 0)

        return min(fits, key=away)


def _publishers(rows: Rows, members: NDArray[np.intp], says: dict[int, str]) -> list[NDArray[np.intp]]:
    """Divide the rows of one boot time by who made them, where it is the boot time of two."""
    members = np.sort(members)
    if not _conflict(rows, members):
        return [members]
    network = members[rows.link[members] == Link.SBN]
    sender = rows.spacecraft_id[network].astype(np.uint64) << 32 | rows.processor_id[network]
    labels = np.array([f"{who >> 32}:{who & 0xFFFFFFFF}" for who in sender.tolist()], object)
    output = members[rows.link[members] == Link.TO]
    # What a Telemetry Output sends is its own, or was handed on and crossed SBN before.
    from_ = latest_equal(
        rows.packet_print[network], rows.time_ns[network], rows.packet_print[output], rows.time_ns[output]
    )
    owner: dict[int, str] = {int(rows.source[row]): says[row] for row in output.tolist() if row in says}
    own = [
        labels[at] if at >= 0 else owner.get(source, f"from {source}")
        for at, source in zip(from_.tolist(), rows.source[output].tolist(), strict=True)
    ]
    rows_of = np.concatenate((network, output))
    label = np.concatenate((labels, np.array(own, object)))
    return [np.sort(rows_of[label == who]) for who in sorted(set(label.tolist()))]


def _conflict(rows: Rows, members: NDArray[np.intp]) -> bool:
    """Tell whether 0x803 comes with one count and different contents: two instances make it."""
    counters = members[rows.msg_id[members] == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID]
    sequence, prints = rows.sequence_count[counters].tolist(), rows.packet_print[counters].tolist()
    counts = Counter(count for count, _ in set(zip(sequence, prints, strict=True)))
    return sum(number > 1 for number in counts.values()) > len(counts) // 4
