"""The content of mission files as values."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import RouteError
from edoras_tools.mission.scalars import read_scalar
from edoras_tools.model import Endpoint, Link
from edoras_tools.wire.msg_id import VERSION_1, MsgIds

if TYPE_CHECKING:
    from collections.abc import Mapping

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.wire.transfer_frames import FrameFormat


class Handling(msgspec.Struct, frozen=True):
    """How ``edoras bridge`` treats a topic; the public bridges ignore it. None: not in the file.

    Attributes:
        max_rate: messages a second at the most.
        keep: above the rate, ``latest`` sends the newest message when its time comes; ``first`` drops it.
        reliable: quality of service: lost samples are sent again.
        transient_local: quality of service: late subscribers get the last samples.
        depth: quality of service: samples kept.
        to_limit: have Telemetry Output send it, with this many waiting at the most.
    """

    max_rate: float | None = None
    keep: Literal["latest", "first"] | None = None
    reliable: bool | None = None
    transient_local: bool | None = None
    depth: int | None = None
    to_limit: int | None = None


class Route(msgspec.Struct, frozen=True):
    """One ROS topic and the MsgId that carries it.

    Attributes:
        topic: with a leading slash.
        type: ROS type name, ``package/msg/Name``.
        msg_id: cFE MsgId, 1 to 0x1FFF.
        link: the one that carries messages of this kind of bridge in this direction.
        direction: named from the bridge's side, as in the file.
        key: the name that the file gives the mapping.
        file: the file, as it was named when loaded.
        line: where the mapping starts, from 1.
        envelope: ``auto`` or the name of a ``wire.envelope.EnvelopeFormat``; None where not given.
        handling: for ``edoras bridge``, with the defaults of its bridge filled in.
    """

    topic: str
    type: str
    msg_id: int
    link: Link
    direction: Literal["command", "telemetry"]
    key: str = ""
    file: str = ""
    line: int = 0
    envelope: str | None = None
    handling: Handling = Handling()

    @property
    def to_cfs(self) -> bool:
        """Whether the message travels towards cFS: a bridge's commands do, its telemetry comes from there."""
        return self.direction == "command"


class GroundLink(msgspec.Struct, frozen=True):
    """``communication`` of a ground bridge: CI and TO of one cFS.

    Attributes:
        bridge_port: UDP port where the bridge receives telemetry.
        fsw_port: UDP port of Command Ingest.
        fsw_ip: IPv4 address of cFS.
        telemetry_ip: IPv4 address that the bridge binds; ``0.0.0.0`` is any.
        bridge_ip: IPv4 address of the bridge's machine, which Telemetry Output is told to send to.
        file: the file, as it was named when loaded.
        line: where ``communication`` starts, from 1.
    """

    kind: ClassVar = "ground"

    bridge_port: int
    fsw_port: int
    fsw_ip: str
    telemetry_ip: str
    bridge_ip: str | None = None
    file: str = ""
    line: int = 0

    @property
    def command_ingest(self) -> Endpoint:
        """Where commands are sent."""
        return Endpoint(self.fsw_ip, self.fsw_port)


class FlightLink(msgspec.Struct, frozen=True):
    """``communication`` of a flight bridge: a Software Bus Network peer of one cFS.

    Attributes:
        peer_ip: IPv4 address of cFS.
        peer_port: UDP port of its SBN.
        peer_processor_id: ProcessorID of cFS, 32 bits.
        peer_spacecraft_id: SpacecraftID of cFS, 32 bits.
        udp_receive_port: UDP port of the bridge.
        udp_receive_ip: IPv4 address that the bridge binds; ``0.0.0.0`` is any.
        processor_id: ProcessorID of the bridge.
        spacecraft_id: SpacecraftID of the bridge.
        file: the file, as it was named when loaded.
        line: where ``communication`` starts, from 1.
    """

    kind: ClassVar = "flight"

    peer_ip: str
    peer_port: int
    peer_processor_id: int
    peer_spacecraft_id: int
    udp_receive_port: int
    udp_receive_ip: str
    processor_id: int
    spacecraft_id: int
    file: str = ""
    line: int = 0

    @property
    def peer(self) -> Endpoint:
        """The SBN port of cFS."""
        return Endpoint(self.peer_ip, self.peer_port)

    @property
    def bridge(self) -> Endpoint:
        """The bridge's own port; address ``0.0.0.0`` is any."""
        return Endpoint(self.udp_receive_ip, self.udp_receive_port)


class TransferLink(msgspec.Struct, frozen=True):
    """``cfdp`` of EDORAS's ``data_transfer``: two CFDP entities.

    Attributes:
        port: UDP port of the entity.
        port_peer: UDP port of the other one.
        file: the file, as it was named when loaded.
        line: where ``cfdp`` starts, from 1.
    """

    kind: ClassVar = "transfer"

    port: int
    port_peer: int
    file: str = ""
    line: int = 0


class StoredTopic(msgspec.Struct, frozen=True):
    """A topic whose messages EDORAS's ``data_transfer`` writes to a file, for CFDP.

    Attributes:
        topic: with a leading slash.
        type: ROS type name, ``package/msg/Name``.
        file_name: of the file, without its folder.
    """

    topic: str
    type: str
    file_name: str


class RecordedTopic(msgspec.Struct, frozen=True):
    """A topic of a recording that has no datagrams, as it was recorded.

    Attributes:
        topic: with a leading slash.
        type: name of its schema; empty where it has none.
        encoding: of its messages, e.g. ``cdr`` or ``json``.
        schema_encoding: of the schema, e.g. ``ros2msg``; empty where it has none.
        schema: its bytes.
        metadata: of the channel, e.g. ``offered_qos_profiles``.
        unread: why its messages are not read; empty where they are.
    """

    topic: str
    type: str
    encoding: str = "cdr"
    schema_encoding: str = ""
    schema: bytes = b""
    metadata: Mapping[str, str] = msgspec.field(default_factory=dict)
    unread: str = ""


class FramedPort(msgspec.Struct, frozen=True):
    """One of ``frames``: a port of CCSDS transfer frames.

    Attributes:
        name: that the file gives it.
        port: where they are sent to; of TCP, that of either end.
        format: of the frames.
        link: the one that the packets in them belong to.
        file: the file, as it was named when loaded.
        line: where it starts, from 1.
    """

    name: str
    port: int
    format: FrameFormat
    link: Link
    file: str = ""
    line: int = 0


class Bridge(msgspec.Struct, frozen=True):
    """One bridge: link, routes and limits, all that is needed to run in its place.

    Attributes:
        name: of its node, fully qualified; empty where the file gives none.
        link: where it talks to cFS.
        routes: its own, in the order of the file.
        max_rate_total: messages a second to cFS at the most, all topics together; None where not given.
        max_size: bytes of a packet that its cFS takes; None where not given.
    """

    name: str
    link: GroundLink | FlightLink
    routes: tuple[Route, ...]
    max_rate_total: float | None = None
    max_size: int | None = None


class FlightSoftware(msgspec.Struct, frozen=True):
    """One cFS, as files and the command line have it; what nobody says is not here.

    Attributes:
        constants: by their names in ``SimProfile``.
        limits: MsgId of version 1 to how many of it may wait at Telemetry Output.
        headers: how packets are built, by the names of ``decode.Options``; ``ports`` are those of links that
            no bridge has, ``LINK:PORT`` each.
    """

    constants: Mapping[str, Any] = msgspec.field(default_factory=dict)
    limits: Mapping[int, int] = msgspec.field(default_factory=dict)
    headers: Mapping[str, Any] = msgspec.field(default_factory=dict)

    def stating(self, constants: Mapping[str, Any]) -> FlightSoftware:
        """Return the same with other constants in place of those that it has."""
        limits = {} if "to_limits" in constants else self.limits
        return replace(self, constants={**self.constants, **constants}, limits=limits)

    @property
    def big_endian(self) -> bool:
        """Whether counters and events have the highest byte first."""
        return bool(self.constants.get("big_endian"))

    @property
    def profile(self) -> SimProfile:
        """All constants: those that nobody says are the usual ones.

        Raises:
            ConfigError: one cannot have that value.
        """
        from edoras_tools.cfs.profile import SimProfile

        return SimProfile().stating(self.constants, self.limits)


class Mission(msgspec.Struct, frozen=True):
    """The content of all mission files; ``Mission()`` is valid and empty.

    Attributes:
        routes: in the order of the files; of one link no two have the same MsgId.
        links: one a bridge, and one a pair of CFDP entities.
        files: raw contents by base name, for attachments.
        warnings: one line each: what a bridge accepts but is probably a mistake.
        bridges: link and routes of each bridge together.
        msg_ids: the version of the MsgIds.
        frames: the ports of transfer frames; no port twice.
        pdu_msg_ids: of packets that hold a CFDP PDU each, as those of cFS's CF app.
        stored_topics: topics whose messages travel as files.
        software: what they say of the flight software itself.
        spacecraft: name and address of each that has a name; their numbers are 1, 2 and so on. Where
            several have one, topics of ``routes`` begin with the first one's.
        number: of the spacecraft whose topics ``routes`` have.
        recorded: not of files: the topics of a recording without datagrams, one for each of ``routes``.
    """

    routes: tuple[Route, ...] = ()
    links: tuple[GroundLink | FlightLink | TransferLink, ...] = ()
    files: Mapping[str, bytes] = msgspec.field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    bridges: tuple[Bridge, ...] = ()
    msg_ids: MsgIds = VERSION_1
    frames: tuple[FramedPort, ...] = ()
    pdu_msg_ids: tuple[int, ...] = ()
    stored_topics: tuple[StoredTopic, ...] = ()
    recorded: tuple[RecordedTopic, ...] = ()
    software: FlightSoftware = msgspec.field(default_factory=FlightSoftware)
    spacecraft: tuple[tuple[str, str], ...] = ()
    number: int = 1

    def prefix(self, spacecraft: int) -> str:
        """Return what the topics of a spacecraft begin with: nothing those of the first, or ``/sc_NAME``."""
        plain = spacecraft == 1 and len(self.spacecraft) < 2
        return "" if plain else f"/sc_{self.called(spacecraft).rpartition(' ')[2]}"

    def own_name(self, name: str, spacecraft: int) -> str:
        """Return what a topic or packet of a spacecraft is called: behind its prefix, plain of the first."""
        prefix = self.prefix(spacecraft)
        return name if spacecraft == 1 or name.startswith(prefix) else f"{prefix}/{name}".rstrip("/")

    def number_of(self, name: str) -> int:
        """Return the number of the spacecraft whose topics have a name in front; 0 where none can."""
        names = [own for own, _ in self.spacecraft]
        if name in names:
            return names.index(name) + 1
        return int(name) if name.isdecimal() and int(name) > max(len(names), 1) else 0

    def called(self, spacecraft: int) -> str:
        """Return how people call a spacecraft."""
        own = self.spacecraft[spacecraft - 1 : spacecraft]
        return f"spacecraft {own[0][0] if own else spacecraft}"

    def of(self, spacecraft: int) -> Mission:
        """Return the mission with the topics of a spacecraft."""
        before, own = self.prefix(self.number), self.prefix(spacecraft)
        topics = (own + route.topic.removeprefix(before) for route in self.routes)
        routes = (replace(route, topic=topic) for route, topic in zip(self.routes, topics, strict=True))
        return replace(self, routes=tuple(routes), number=spacecraft)

    def numbered(self, msg_ids: MsgIds) -> Mission:
        """Return the same mission with the MsgIds that its packets have in another version."""
        if msg_ids is self.msg_ids:
            return self

        def renumbered(routes: tuple[Route, ...]) -> tuple[Route, ...]:
            standard, of_known = self.msg_ids.standard, msg_ids.of_known
            return tuple(replace(item, msg_id=of_known(standard(item.msg_id))) for item in routes)

        bridges = tuple(replace(item, routes=renumbered(item.routes)) for item in self.bridges)
        pdus = tuple(msg_ids.of_known(self.msg_ids.standard(item)) for item in self.pdu_msg_ids)
        routes = renumbered(self.routes)
        return replace(self, routes=routes, bridges=bridges, msg_ids=msg_ids, pdu_msg_ids=pdus)

    @property
    def ground(self) -> tuple[GroundLink, ...]:
        """The links of ground bridges."""
        return tuple(item for item in self.links if isinstance(item, GroundLink))

    @property
    def flight(self) -> tuple[FlightLink, ...]:
        """The links of flight bridges."""
        return tuple(item for item in self.links if isinstance(item, FlightLink))

    def find(self, name: str | int) -> Route:
        """Return the route of a topic (leading slash or not), a key, or a MsgId (as 0x827 or ``"0x827"``).

        Raises:
            RouteError: no route is called that, or several are.
        """
        text = str(name)
        msg_id = read_scalar(text)
        if isinstance(msg_id, int) and not isinstance(msg_id, bool):
            text = f"0x{msg_id:04X}"
            matches = [route for route in self.routes if route.msg_id == msg_id]
        else:
            topic = "/" + text.removeprefix("/")
            matches = [route for route in self.routes if route.topic == topic]
            matches = matches or [route for route in self.routes if route.key == text]
        if len(matches) == 1:
            return matches[0]
        choices = [
            f"{item.topic} (0x{item.msg_id:04X}, {item.link.label})" for item in matches or self.routes
        ]
        if matches:
            raise RouteError(
                f"{text!r} names {len(matches)} routes: {', '.join(choices)}; say which by another name"
            )
        if not choices:
            raise RouteError(f"{text!r}: no topic is configured; give mission files with -c")
        raise RouteError(f"{text!r} is not configured; there are {', '.join(choices)}")
