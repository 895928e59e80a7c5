"""The content of mission files as values."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.errors import RouteError
from edoras_tools.mission.tree import read_scalar
from edoras_tools.model import Endpoint, Link
from edoras_tools.wire.ccsds import VERSION_1, MsgIds

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.wire.transfer_frames import FrameFormat


class Handling(msgspec.Struct, frozen=True):
    """How ``edoras bridge`` treats a topic; the public bridges ignore it. None: the key is not in the file.

    Attributes:
        max_rate: most messages a second, Hz.
        keep: above the rate, ``latest`` keeps the newest message until the next send time; ``first`` drops
            it.
        reliable: quality of service: whether lost samples are sent again.
        transient_local: quality of service: whether late subscribers get the last samples.
        depth: quality of service: samples kept.
        to_limit: most messages of this topic that may wait at Telemetry Output, which is told to send it.
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
        topic: topic name with a leading slash.
        type: ROS type name, ``package/msg/Name``.
        msg_id: cFE MsgId, 1 to 0x1FFF.
        link: link that carries messages of this kind of bridge in this direction.
        direction: direction from the bridge's side, as in the file.
        key: name of the mapping in the file.
        file: name under which the file was loaded.
        line: line where the mapping starts, from 1.
        envelope: ``auto`` or the name of a ``wire.envelope.EnvelopeFormat``; None if the file has none.
        handling: handling by ``edoras bridge``, with the defaults of its bridge filled in.
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
        """Whether the message travels towards cFS: a bridge's commands do, its telemetry comes from cFS."""
        return self.direction == "command"


class GroundLink(msgspec.Struct, frozen=True):
    """``communication`` of a ground bridge: CI and TO of one cFS.

    Attributes:
        bridge_port: UDP port where the bridge receives telemetry.
        fsw_port: UDP port of Command Ingest.
        fsw_ip: IPv4 address of cFS.
        telemetry_ip: IPv4 address that the bridge binds; ``0.0.0.0`` is any.
        bridge_ip: IPv4 address of the bridge's machine, to which Telemetry Output sends; None if not given.
        file: name under which the file was loaded.
        line: line where ``communication`` starts, from 1.
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
        file: name under which the file was loaded.
        line: line where ``communication`` starts, from 1.
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
        port_peer: UDP port of the other entity.
        file: name under which the file was loaded.
        line: line where ``cfdp`` starts, from 1.
    """

    kind: ClassVar = "transfer"

    port: int
    port_peer: int
    file: str = ""
    line: int = 0


class StoredTopic(msgspec.Struct, frozen=True):
    """A topic whose messages EDORAS's ``data_transfer`` writes to a file, for CFDP.

    Attributes:
        topic: topic name with a leading slash.
        type: ROS type name, ``package/msg/Name``.
        file_name: name of the file, without its folder.
    """

    topic: str
    type: str
    file_name: str


class RecordedTopic(msgspec.Struct, frozen=True):
    """A topic of a recording that has no datagrams, as it was recorded.

    Attributes:
        topic: topic name with a leading slash.
        type: name of its schema; empty if it has none.
        encoding: encoding of its messages, as ``cdr`` or ``json``.
        schema_encoding: encoding of the schema, as ``ros2msg``; empty if it has none.
        schema: bytes of the schema.
        metadata: metadata of the channel, as ``offered_qos_profiles``.
        unread: reason why its messages are not read; empty if they are.
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
        name: name in the file.
        port: destination port of the frames; for TCP, the port of either end.
        format: format of the frames.
        link: link that the packets in the frames belong to.
        file: name under which the file was loaded.
        line: line where its group starts, from 1.
    """

    name: str
    port: int
    format: FrameFormat
    link: Link
    file: str = ""
    line: int = 0


class Bridge(msgspec.Struct, frozen=True):
    """One bridge: link, routes and limits, all values that are needed to run in its place.

    Attributes:
        name: fully qualified name of its node; empty if the file gives none.
        link: link between the bridge and cFS.
        routes: its own routes, in the order of the file.
        max_rate_total: most messages a second to cFS, all topics together, Hz; None if not given.
        max_size: most bytes of a packet that its cFS takes; None if not given.
    """

    name: str
    link: GroundLink | FlightLink
    routes: tuple[Route, ...]
    max_rate_total: float | None = None
    max_size: int | None = None


class FlightSoftware(msgspec.Struct, frozen=True):
    """One cFS, as files and the command line describe it; values that neither states are missing here.

    Attributes:
        constants: constants by their names in ``SimProfile``.
        limits: most packets that may wait at Telemetry Output, by MsgId of version 1.
        headers: packet format, by the names of ``decode.Options``; ``ports`` are those of links that
            no bridge has, each as ``LINK:PORT``.
    """

    constants: Mapping[str, Any] = msgspec.field(default_factory=dict)
    limits: Mapping[int, int] = msgspec.field(default_factory=dict)
    headers: Mapping[str, Any] = msgspec.field(default_factory=dict)

    def stating(self, constants: Mapping[str, Any]) -> FlightSoftware:
        """Return the same cFS with ``constants`` in place of those that it has."""
        limits = {} if "to_limits" in constants else self.limits
        return replace(self, constants={**self.constants, **constants}, limits=limits)

    @property
    def big_endian(self) -> bool:
        """Whether counters and events are big-endian."""
        return bool(self.constants.get("big_endian"))

    @property
    def profile(self) -> SimProfile:
        """All constants; a constant that is not stated has its usual value.

        Raises:
            ConfigError: a constant cannot have its value.
        """
        from edoras_tools.cfs.profile import SimProfile

        return SimProfile().stating(self.constants, self.limits)


class Mission(msgspec.Struct, frozen=True):
    """The content of all mission files; ``Mission()`` is valid and empty.

    Attributes:
        routes: routes in the order of the files; no two of one link have the same MsgId.
        links: one link a bridge, and one a pair of CFDP entities.
        files: raw contents by base name, for attachments.
        warnings: one line each: what a bridge accepts but is probably a mistake.
        bridges: link and routes of each bridge together.
        msg_ids: version of the MsgIds.
        frames: ports of transfer frames; no port twice.
        pdu_msg_ids: MsgIds of packets that hold one CFDP PDU each, as those of cFS's CF app.
        stored_topics: topics whose messages travel as files.
        recorded: topics of a recording without datagrams, one for each of ``routes``; files have none.
        software: the flight software, as the files describe it.
        spacecraft: name and address of each spacecraft with a name; their numbers are 1, 2 and so on. If
            several have a name, topics of ``routes`` begin with the name of the first.
        number: number of the spacecraft whose topics ``routes`` have.
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
        """Return a topic prefix, ``/sc_NAME``; empty for the first spacecraft unless several have a name."""
        plain = spacecraft == 1 and len(self.spacecraft) < 2
        return "" if plain else f"/sc_{self.called(spacecraft).rpartition(' ')[2]}"

    def own_name(self, name: str, spacecraft: int) -> str:
        """Return a topic or packet name with its spacecraft's prefix; names of the first stay as they are."""
        prefix = self.prefix(spacecraft)
        return name if spacecraft == 1 or name.startswith(prefix) else f"{prefix}/{name}".rstrip("/")

    def number_of(self, name: str) -> int:
        """Return the number of the spacecraft whose topics start with a name; 0 if there can be none."""
        names = [own for own, _ in self.spacecraft]
        if name in names:
            return names.index(name) + 1
        return int(name) if name.isdecimal() and int(name) > max(len(names), 1) else 0

    def called(self, spacecraft: int) -> str:
        """Return the name of a spacecraft for people, as ``spacecraft rover``."""
        own = self.spacecraft[spacecraft - 1 : spacecraft]
        return f"spacecraft {own[0][0] if own else spacecraft}"

    def of(self, spacecraft: int) -> Mission:
        """Return the same mission with the topics of a spacecraft."""
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
            RouteError: no route has this name, or several have it.
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
