"""Records a step of a sweep: every datagram, sent and received, as a capture that the diagnosis can judge.

It also keeps facts that a capture does not show: whether an echo equals the sent message, and the time from
which no message is in transit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.simulation import WireDatagram
from edoras_tools.cfs import command_ingest
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Diagnosis, Examination
from edoras_tools.io.frames.build import frames_of
from edoras_tools.io.frames.linklayer import demux
from edoras_tools.links.table import carrying
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Endpoint, Link
from edoras_tools.pipelines.sending.responses import Responses
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe, sbn

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.pipelines.workbench import Workbench

_SLOTS: Final = cfe.SOFTWARE_BUS_HOUSEKEEPING.by_name
_LOSSES: Final = slice(_SLOTS["pipe_overflow_error_counter"].start, _SLOTS["message_limit_error_counter"].end)
"""Bytes of both loss counters in the payload of 0x803."""
_COUNTERS: Final = (cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID, command_ingest.HOUSEKEEPING_MSG_ID)
_BEFORE_NS: Final = 2500 * MILLISECOND
"""Time before a step whose housekeeping is kept, if steps follow each other without a pause."""
# The link of a datagram is known whatever its real ports are; for the diagnosis these ports identify it.
_TO_PORT: Final = 50001


def _ends(link: Link) -> tuple[Endpoint, Endpoint]:
    """Return a link's endpoint on the ground or at the robot, and its endpoint at cFS."""
    if link.peers:
        return Endpoint("127.0.0.1", 2236), Endpoint("127.0.0.1", 2234)
    if link.only_from_cfs:
        return Endpoint("127.0.0.1", _TO_PORT), Endpoint("127.0.0.1", 50002)
    return Endpoint("127.0.0.1", 50000), Endpoint("127.0.0.1", 1234)


class Mark(msgspec.Struct, frozen=True):
    """The counts at one moment.

    Attributes:
        arrived: messages of the route that came from cFS.
        whole: messages among them that were as expected.
        reports: 0x803 packets so far.
        counters: the loss counters of the last 0x803 and the contents of the last 0x884, if they have come.
        differs_at: first byte at which a message differed from the expected one; None if none differed.
    """

    arrived: int = 0
    whole: int = 0
    reports: int = 0
    counters: tuple[bytes, ...] = ()
    differs_at: int | None = None


class Observer:
    """Records the datagrams of a step.

    Attributes:
        seen: counts of everything received since the start.
        expected: the bytes that a message of the route must have; None for any.
        expected_size: the length that it must have; 0 for any.
        largest: bytes of the longest one received.
    """

    def __init__(self, bench: Workbench, route: Route) -> None:
        context = bench.columns.context
        self.seen = Responses(bench.mission)
        self.expected: bytes | None = None
        self.expected_size = 0
        self.largest = 0
        options = replace(context.options, ports=((carrying("ground", to_cfs=False), _TO_PORT),))
        self._context = Context(Mission(routes=bench.mission.routes), bench.types, options)
        self._route, self._msg_ids = route, bench.mission.msg_ids
        self._datagrams: list[tuple[int, WireDatagram]] = []
        self._latest: dict[int, WireDatagram] = {}
        self._counters: dict[int, bytes] = {}
        self._quiet_ns = 0
        self._arrived = self._whole = self._reports = 0
        self._differs_at: int | None = None

    def sent(self, data: bytes, now: int) -> None:
        """Record a datagram that was sent, at ``now``, ns since 1970."""
        link = carrying("flight" if self._route.link.peers else "ground", to_cfs=True)
        source, destination = _ends(link)
        self._datagrams.append(
            (self._msg_id(_packet(link, data)), WireDatagram(now, source, destination, data))
        )

    def received(self, link: Link, data: bytes, now: int) -> None:
        """Record a datagram that was received, any bytes, at ``now``, ns since 1970."""
        self.seen.add(link, data, now)
        own, peer = _ends(link)
        packet, item = _packet(link, data), WireDatagram(now, peer, own, data)
        msg_id = self._msg_id(packet)
        standard = self._msg_ids.standard(msg_id)
        self._datagrams.append((msg_id, item))
        if standard in _COUNTERS:
            self._latest[msg_id] = item
            of_bus = standard == cfe.SOFTWARE_BUS_HOUSEKEEPING_MSG_ID
            # The rest of 0x803 changes all the time: messages without a subscriber, memory in use.
            payload = packet[cfe.TELEMETRY_HEADER_BYTES :]
            self._counters[msg_id] = payload[_LOSSES] if of_bus else payload
            self._reports += of_bus
        if msg_id == self._route.msg_id:
            self._compare(packet)

    def _compare(self, packet: bytes) -> None:
        self._arrived += 1
        self.largest = max(self.largest, len(packet))
        if self.expected is not None and packet != self.expected:
            pairs = zip(packet, self.expected, strict=False)
            shorter = min(len(packet), len(self.expected))
            same = next((at for at, (a, b) in enumerate(pairs) if a != b), shorter)
            self._differs_at = same if self._differs_at is None else min(self._differs_at, same)
        elif not self.expected_size or len(packet) == self.expected_size:
            self._whole += 1

    def quiet(self, now: int) -> None:
        """Record that no message of the step is in transit from ``now`` on."""
        self._quiet_ns = now

    def begin(self) -> None:
        """Start a step after a quiet time: only the last values of the counters are kept."""
        self._forget(self._quiet_ns)

    def go_on(self, now: int) -> None:
        """Start a step directly after the last one: a gap before its first message counts."""
        last = [item for item in self._datagrams if item[0] == self._route.msg_id][-1:]
        self._forget(now - _BEFORE_NS)
        self._datagrams = sorted(last + self._datagrams, key=lambda item: item[1].time_ns)

    def _forget(self, since_ns: int) -> None:
        judged = {self._route.msg_id, self._msg_ids.of_known(cfe.EVENT_MSG_ID)}
        rest = [item for item in self._datagrams if item[1].time_ns >= since_ns and item[0] not in judged]
        older = [item for item in self._latest.items() if item[1].time_ns < since_ns]
        self._datagrams = sorted(older, key=lambda item: item[1].time_ns) + rest
        self._differs_at = None

    def mark(self) -> Mark:
        """Return the counts so far."""
        return Mark(
            arrived=self._arrived,
            whole=self._whole,
            reports=self._reports,
            counters=tuple(self._counters.values()),
            differs_at=self._differs_at,
        )

    def _msg_id(self, packet: bytes) -> int:
        return self._msg_ids.of(packet) if len(packet) >= cfe.COMMAND_HEADER_BYTES else -1

    def diagnose(self, profile: SimProfile) -> Diagnosis:
        """Diagnose the step, as the doctor does with a capture."""
        examination = Examination(self._context, profile)
        if self._datagrams:
            batch = demux(frames_of([item for _, item in self._datagrams]))
            examination.add(batch, ColumnDecoder(self._context).decode(batch))
        # The messages were sent to this side, so a missing one is lost, not only missing in the capture.
        return examination.diagnose(Capture(drops=0))


def _packet(link: Link, data: bytes) -> bytes:
    """Return the space packet in a datagram; empty if it contains none."""
    if not link.peers:
        return data
    carries = len(data) >= sbn.HEADER.size and sbn.HEADER.parse(data)["msg_type"] == sbn.MsgType.APP
    return data[sbn.HEADER.size :] if carries else b""
