"""Drafts a mission file from a capture: which MsgIds carry EDORAS messages, and their possible types.

The draft marks its guesses: all names of topics, and types if several fit.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs.names import message_name
from edoras_tools.decode.conversations import ConversationKind, Flow
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT
from edoras_tools.errors import CaptureError
from edoras_tools.links import table
from edoras_tools.links.table import among, carrying
from edoras_tools.model import NO_MSG_ID, NO_ROUTE, Columns, Endpoint, Link, PacketBatch, Peer
from edoras_tools.pipelines.reading import reading
from edoras_tools.ros.store import types_that_fit
from edoras_tools.wire import cfe
from edoras_tools.wire.arrays import Places, by_value
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat, detect
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Settings, Workbench
    from edoras_tools.render.terminal.text import Progress
    from edoras_tools.wire.ccsds import MsgIds

    OpenInput = Callable[[Settings], tuple[Source, Workbench]]

_SAMPLES: Final = 64
"""Most different messages of a MsgId that types are tested on."""
_OF_A_BATCH: Final = 64
"""Most messages of a MsgId that are examined in a batch, and as many of different lengths."""
_ENOUGH: Final = 3
"""Envelopes that are enough to show that a MsgId carries EDORAS messages, whatever else it carries."""
_SECONDARY_HEADER: Final = 0x0800
_HEADER: Final = """\
# Drafted from {name}.
# A capture shows MsgIds, addresses and the shape of messages, but no names: rename the topics, and check the
# types that are marked with a question mark. Then give this file with -c.
"""


class _Stream(msgspec.Struct):
    """The messages of one MsgId of one sender on one link.

    Attributes:
        count: number of packets.
        samples: CDR of some of them, each once.
        formats: envelope formats of the examined messages.
        bare: number of examined messages without a whole envelope.
    """

    link: Link
    msg_id: int
    processor_id: int
    count: int = 0
    samples: dict[bytes, None] = msgspec.field(default_factory=dict)
    formats: Counter[EnvelopeFormat] = msgspec.field(default_factory=Counter)
    bare: int = 0

    def look(self, payload: bytes) -> None:
        """Examine the bytes behind a cFE header."""
        envelope = detect(payload)
        if envelope is None:
            self.bare += 1
        else:
            self.formats[envelope] += 1
            length, _ = envelope.parse(payload)
            if len(self.samples) < _SAMPLES:
                self.samples[payload[envelope.size : envelope.size + length]] = None

    @property
    def name(self) -> str:
        """Name of the stream for people."""
        return f"0x{self.msg_id:04x} ({self.link.name})"


class _Traffic(msgspec.Struct):
    """The traffic of the bridges in a capture.

    Attributes:
        streams: messages by link, MsgId and processor.
        ways: number of datagrams of each link by source and destination.
        peers: number of datagrams of each SBN peer by source.
        orders: number of events by the byte order that their types show.
        flight: number of packets that show that a peer is cFS: its events, or its own messages on SBN.
        configured: MsgIds that the missions name, which are not drafted.
        msg_ids: version of the MsgIds.
    """

    msg_ids: MsgIds

    streams: dict[tuple[Link, int, int], _Stream] = msgspec.field(default_factory=dict)
    ways: dict[Link, Counter[tuple[str, Endpoint]]] = msgspec.field(default_factory=dict)
    peers: dict[Peer, Counter[Endpoint]] = msgspec.field(default_factory=dict)
    orders: Counter[str] = msgspec.field(default_factory=Counter)
    flight: Counter[int] = msgspec.field(default_factory=Counter)
    configured: set[int] = msgspec.field(default_factory=set)

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch."""
        bridged = among(columns.link, lambda link: bool(link.bridge))
        carries = bridged & (columns.msg_id != NO_MSG_ID)
        self.configured.update(np.unique(columns.msg_id[carries & (columns.route != NO_ROUTE)]).tolist())
        self._add_ways(batch, columns, np.flatnonzero(bridged))
        standard = cfe.known_ids(columns.msg_id, columns.headers)
        events = np.flatnonzero(carries & (standard == cfe.EVENT_MSG_ID))[:_OF_A_BATCH]
        for payload in (_payload(batch, columns, row) for row in events.tolist()):
            if len(payload) >= cfe.EVENT.size - 2:  # some builds omit the last two bytes
                event = cfe.EVENT.parse(payload.ljust(cfe.EVENT.size, b"\0"))
                is_big = event["event_type"] > 0xFF and not event["event_type"] & 0xFF
                self.orders["big" if is_big else "little"] += 1
                number = event["processor_id"].to_bytes(4, "big" if is_big else "little")
                self.flight[int.from_bytes(number, "little")] += 1
        loose = np.flatnonzero(carries & (columns.route == NO_ROUTE))
        keys = columns.msg_id[loose].astype(np.int64) << 40 | columns.link[loose].astype(np.int64) << 32
        for key, members in by_value(keys | columns.processor_id[loose].astype(np.int64)):
            self._add_stream(batch, columns, key, loose[members])

    def _add_stream(self, batch: PacketBatch, columns: Columns, key: int, members: Places) -> None:
        link, msg_id, processor_id = table.link(key >> 32 & 0xFF), key >> 40, key & 0xFFFFFFFF
        if message_name(self.msg_ids.standard(msg_id)):
            if link.peers and not self.msg_ids.is_command(msg_id):
                self.flight[processor_id] += len(members)
            return
        stream = self.streams.setdefault((link, msg_id, processor_id), _Stream(link, msg_id, processor_id))
        stream.count += len(members)
        _, first = np.unique(columns.packet_length[members], return_index=True)
        spread = members[:: max(1, len(members) // _OF_A_BATCH)]
        for row in {*spread[:_OF_A_BATCH].tolist(), *members[first[:_OF_A_BATCH]].tolist()}:
            stream.look(_payload(batch, columns, row))

    def _add_ways(self, batch: PacketBatch, columns: Columns, rows: Places) -> None:
        names = ("source_address", "source_port", "destination_address", "destination_port")
        parts = [getattr(batch, name)[rows].astype(np.int64) for name in names]
        parts += [columns.link[rows].astype(np.int64), columns.processor_id[rows].astype(np.int64)]
        parts.append(columns.spacecraft_id[rows].astype(np.int64))
        if not len(rows):
            return
        distinct, first, counts = np.unique(np.stack(parts, 1), axis=0, return_index=True, return_counts=True)
        for (*_, code, processor_id, spacecraft_id), at, count in zip(
            distinct.tolist(), first.tolist(), counts.tolist(), strict=True
        ):
            link, datagram = table.link(code), batch[int(rows[at])]
            ways = self.ways.setdefault(link, Counter())
            ways[datagram.source.address, datagram.destination] += count
            if link.peers and processor_id:
                sources = self.peers.setdefault(Peer(spacecraft_id, processor_id), Counter())
                sources[datagram.source] += count


def _payload(batch: PacketBatch, columns: Columns, row: int) -> bytes:
    start = int(columns.packet_offset[row])
    at = start + int(columns.header_length[row])
    return batch.data[at : start + int(columns.packet_length[row])].tobytes()


class MissionDraft(msgspec.Struct, frozen=True):
    """A mission file from a capture.

    Attributes:
        text: text of the file.
        topics: number of topics in it.
        sure: number of topics that only one type fits.
        notes: one line for each thing that was left out.
        failure: error that ended the capture early, if any; the draft covers what was read before.
        constants: number of constants of cFS in it.
    """

    text: str
    topics: int
    sure: int
    notes: Sequence[str]
    failure: CaptureError | None = None
    constants: int = 0


class CapturedTraffic(msgspec.Struct, frozen=True):
    """The traffic that was read of one spacecraft.

    Attributes:
        name: name of the capture, behind that of the spacecraft if there are several.
        number: number of the spacecraft.
        bench: workbench with which it was read.
        traffic: traffic of the bridges.
        flows: flows of the capture.
        failure: error that ended the capture early, if any.
    """

    name: str
    number: int
    bench: Workbench
    traffic: _Traffic
    flows: Sequence[Flow]
    failure: CaptureError | None

    def draft(self, rates: Mapping[tuple[str, int], float] | None = None) -> MissionDraft:
        """Draft a mission file.

        Args:
            rates: highest clean rates in Hz, by label of the link and MsgId, for the comments.

        Raises:
            CaptureError: there is nothing to draft.
        """
        return replace(_Writer(self, rates or {}).draft(), failure=self.failure)


def read_traffic(
    opened: OpenInput, settings: Settings, progress: Progress | None = None, *, again: bool = True
) -> tuple[Sequence[CapturedTraffic], Sequence[tuple[Link, int]]]:
    """Read a source to its end; read it again if unnamed ports have traffic that looks like that of a link.

    Args:
        opened: opens the source anew.
        settings: missions, types, and how packets are decoded.
        again: whether the source can be opened twice.

    Returns:
        the traffic of each spacecraft, and those ports.

    Raises:
        CaptureError: the source cannot be read.
    """
    captured = _read(*opened(settings), progress)
    ports = _unnamed_ports(captured[0].flows) if again else []
    if ports:
        options = replace(settings.options, ports=(*settings.options.ports, *ports))
        captured = _read(*opened(replace(settings, options=options)), progress)
    return captured, ports


def each_draft(
    captured: Sequence[CapturedTraffic], make: Callable[[CapturedTraffic], MissionDraft]
) -> dict[str, MissionDraft]:
    """Return the file of each spacecraft that has one, by the prefix of its topics.

    Raises:
        CaptureError: no spacecraft has one.
    """
    drafts: dict[str, MissionDraft] = {}
    errors = []
    for own in captured:
        try:
            drafts[own.bench.mission.prefix(own.number)[1:]] = make(own)
        except CaptureError as error:
            errors.append(error)
    if not drafts:
        raise errors[0]
    return drafts


def _unnamed_ports(flows: Sequence[Flow]) -> list[tuple[Link, int]]:
    """Return the ports whose traffic looks like that of one link, and of no other."""
    links: dict[int, set[Link]] = {}
    for flow in flows:
        if flow.kind is ConversationKind.UNNAMED:
            links.setdefault(flow.destination.port, set()).add(flow.looks_like)
    return [(own.pop(), port) for port, own in sorted(links.items()) if len(own) == 1]


def _read(source: Source, bench: Workbench, progress: Progress | None) -> list[CapturedTraffic]:
    traffic: dict[int, _Traffic] = {}
    with reading(source, bench, keeps_failure=True, conversing=True) as loop:
        for rows in loop:
            batch, columns = rows.batch, rows.columns
            for number, own in by_value(columns.spacecraft):
                some = slice(None) if len(own) == len(batch) else own
                part = traffic.setdefault(number, _Traffic(bench.mission.msg_ids))
                part.add(batch.take(some), columns.take(some))
            if progress is not None:
                progress.read(source)
    if loop.failure is not None and not any(item.streams for item in traffic.values()):
        raise loop.failure
    traffic = traffic or {FIRST_SPACECRAFT: _Traffic(bench.mission.msg_ids)}
    flows, name, several = loop.conversations.judge(), source.info.name, len(traffic) > 1
    called = {number: f"{bench.mission.called(number)} of {name}" if several else name for number in traffic}
    return [
        CapturedTraffic(called[number], number, bench, own, flows, loop.failure)
        for number, own in sorted(traffic.items())
    ]


class _Writer:
    """Writes the mission file."""

    def __init__(self, captured: CapturedTraffic, rates: Mapping[tuple[str, int], float]) -> None:
        self._name, self._rates = captured.name, rates
        self._traffic, self._types = captured.traffic, captured.bench.types
        self._notes: list[str] = []
        self._topics = self._sure = 0

    def draft(self) -> MissionDraft:
        """Return the draft.

        Raises:
            CaptureError: there is nothing to draft.
        """
        name = self._name
        streams = [item for item in self._traffic.streams.values() if self._is_message(item)]
        streams.sort(key=lambda item: (item.link.code, -item.count, item.msg_id))
        lines = [
            *self._ground([item for item in streams if item.link.bridge == "ground"]),
            *self._flight([item for item in streams if item.link.bridge == "flight"]),
        ]
        count_text = plural(len(self._traffic.configured), "MsgId")
        if not self._topics:
            why = f"; {count_text} of it are in the mission already" if self._traffic.configured else ""
            raise CaptureError(f"{name}: no EDORAS message under a MsgId that is not known{why}")
        if self._traffic.configured:
            self._notes.append(f"{count_text} left out: the mission has them already")
        title = "".join(item if item.isprintable() else "?" for item in name)
        text = _HEADER.format(name=title) + "".join(f"{line}\n" for line in lines)
        return MissionDraft(text, self._topics, self._sure, self._notes)

    def _is_message(self, stream: _Stream) -> bool:
        first, _ = self._traffic.msg_ids.words(stream.msg_id)
        valid = first & _SECONDARY_HEADER and stream.msg_id <= cfe.HIGHEST_MSG_ID
        whole = stream.formats.total()
        if valid and whole and whole >= min(stream.bare, _ENOUGH):
            return True
        why = f"{stream.bare:,} of {stream.bare + whole:,} looked at hold no whole EDORAS envelope"
        why = why if valid else "no MsgId of a cFE message with a secondary header"
        self._notes.append(f"{stream.name}: {plural(stream.count, 'packet')} left out: {why}")
        return False

    def _ground(self, streams: list[_Stream]) -> Iterator[str]:
        """Yield the node of the ground bridge."""
        if not streams:
            return
        up, down = (carrying("ground", to_cfs=to_cfs) for to_cfs in (True, False))
        (_, cfs), (_, bridge) = (self._usual_way(link) for link in (up, down))
        yield "ground_conversion_node:"
        yield from self._node(
            {
                "bridge_port": bridge.port,
                "fsw_port": cfs.port,
                "fsw_ip": cfs.address,
                "telemetry_ip": bridge.address,
                "bridge_ip": bridge.address,
            },
            [item for item in streams if item.link == up],
            [item for item in streams if item.link == down],
        )

    def _usual_way(self, link: Link) -> tuple[str, Endpoint]:
        """Return source and destination of most datagrams of a link; the usual port if there are none."""
        ways = self._traffic.ways.get(link, Counter()).most_common()
        targets = list(dict.fromkeys(str(target) for (_, target), _ in ways))
        if len(targets) > 1:
            self._notes.append(f"{link.name} also went to {listed(targets[1:])}: a bridge has one target")
        ports = link.transport.ports
        return ways[0][0] if ways else ("127.0.0.1", Endpoint("127.0.0.1", ports[0]))

    def _flight(self, streams: list[_Stream]) -> Iterator[str]:
        """Yield the node of the flight bridge: its peer is the cFS with most packets."""
        peers = {item.processor_id: item for item in self._traffic.peers}
        if not streams:
            return
        flight = [item for item, _ in self._traffic.flight.most_common() if item in peers] or [min(peers)]
        others = [item for item in self._traffic.peers if item.processor_id not in flight]
        if not others:
            self._notes.append(f"{listed([item.name for item in streams])} left out: between two cFS")
            return
        cfs = peers[flight[0]]
        bridge = max(others, key=lambda item: self._traffic.peers[item].total())
        by_msg_id: dict[int, _Stream] = {}
        for item in streams:
            if item.processor_id not in {cfs.processor_id, bridge.processor_id} or item.msg_id in by_msg_id:
                whose = f"{item.name} of processor {item.processor_id}"
                self._notes.append(f"{whose} left out: a bridge has one peer")
            else:
                by_msg_id[item.msg_id] = item
        cfs_at, bridge_at = (self._traffic.peers[item].most_common(1)[0][0] for item in (cfs, bridge))
        yield "flight_conversion_node:"
        yield from self._node(
            {
                "peer_ip": cfs_at.address,
                "peer_port": cfs_at.port,
                "peer_processor_id": cfs.processor_id,
                "peer_spacecraft_id": cfs.spacecraft_id,
                "udp_receive_port": bridge_at.port,
                "udp_receive_ip": bridge_at.address,
                "processor_id": bridge.processor_id,
                "spacecraft_id": bridge.spacecraft_id,
            },
            [item for item in by_msg_id.values() if item.processor_id == bridge.processor_id],
            [item for item in by_msg_id.values() if item.processor_id == cfs.processor_id],
        )

    def _node(
        self, communication: dict[str, int | str], command: list[_Stream], telemetry: list[_Stream]
    ) -> Iterator[str]:
        """Yield the lines below the name of a node."""
        groups = [("command", "to cFS", command), ("telemetry", "from cFS", telemetry)]
        written = {
            item.msg_id: lines for _, _, some in groups for item in some if (lines := self._topic(item))
        }
        yield "  ros__parameters:"
        yield "    communication:"
        for key, value in communication.items():
            if isinstance(value, str) and ":" in value:
                yield f'      {key}: "0.0.0.0" # {value} was seen, but the bridges take IPv4 only'
            else:
                yield f"      {key}: {json.dumps(value)}"
        for direction, comment, streams in groups:
            keys = [_key(item) for item in streams if item.msg_id in written]
            yield f"    {direction}: {keys or ['']} # {comment}"
        for lines in written.values():
            yield ""
            yield from lines

    def _topic(self, stream: _Stream) -> list[str]:
        """Return the lines of a topic; none if no type fits."""
        samples = list(stream.samples)
        types = self._types
        fits = types_that_fit(types, samples) or types_that_fit(types, samples, types.types())
        examined = plural(len(samples), "different message")
        if not fits:
            self._notes.append(f"{stream.name}: left out: no known type fits {examined}; give --set msg-path")
            return []
        self._topics += 1
        self._sure += len(fits) == 1
        sure = f"the only known type that fits {examined}"
        if len(fits) > 1:
            sure = f"? a guess, tested on {examined}; {listed(fits[1:], 4)} fit too"
        lines = [f"    {_key(stream)}: # {plural(stream.count, 'packet')}", f"      # {sure}"]
        if rate := self._rates.get((stream.link.label, stream.msg_id)):
            lines.append(f"      # none of it was lost at {rate:.1f} Hz, the highest clean rate here")
        if stream.bare:
            looked = stream.bare + stream.formats.total()
            lines.append(f"      # {stream.bare:,} of {looked:,} looked at hold no whole EDORAS envelope")
        lines += [f"      type: {json.dumps(fits[0])}", f'      topic: "/{_key(stream)}"']
        lines.append(f"      mid: 0x{stream.msg_id:X}")
        envelope, _ = stream.formats.most_common(1)[0]
        if envelope != DEFAULT:
            lines.append(f'      envelope: "{envelope}"')
        return lines


def _key(stream: _Stream) -> str:
    """Return the name of a topic, which is also the key of its mapping: link and MsgId."""
    return f"{stream.link.label}_{stream.msg_id:04x}"
