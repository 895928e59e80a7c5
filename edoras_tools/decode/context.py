"""Everything that a decoder needs besides the bytes: the mission, the options and the peers so far."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from msgspec.structs import replace

from edoras_tools.cfs import names
from edoras_tools.decode.spacecraft import FIRST_SPACECRAFT, Builds, CommandTable, Spacecraft
from edoras_tools.errors import ConfigError
from edoras_tools.links import BRIDGE_PORT, table
from edoras_tools.links.doors import Endpoints, Peers
from edoras_tools.mission import FlightLink, GroundLink, Mission
from edoras_tools.model import NO_ROUTE, OTHER, Endpoint, Link
from edoras_tools.structs import Structs, shipped_structs
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.protocol import LinkProtocol
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.arrays import Mask, Octets
    from edoras_tools.wire.ccsds import MsgIds
    from edoras_tools.wire.layout import Layout


_KEPT: Final = ("envelope", "time")
"""Options that a recording stores in their original words."""


class Options(msgspec.Struct, frozen=True):
    """Options for reading bytes that do not describe themselves.

    Attributes:
        extended_header: packets have cFE's extended header; None to detect it.
        telemetry_header: bytes of the telemetry header, primary header included: 16, or 12 in older builds;
            None to detect it.
        msg_id_version: version of the MsgIds: 1, or 2, which needs the extended header; None is 1.
        envelope: format of every route that names none: ``8/8`` and the like, ``auto`` if each packet may
            have its own; None to detect it from the first packets of each route.
        time: format of mission time in headers, as ``MissionTime.of_text`` reads it; unstated parts are
            detected.
        ports: further UDP ports by link; 0: any port, for a link whose datagrams begin with a magic number.
        listened: UDP ports on which a recorder was set to listen: traffic there was requested.
    """

    extended_header: bool | None = None
    telemetry_header: int | None = None
    msg_id_version: int | None = None
    envelope: str | None = None
    time: str | None = None
    ports: tuple[tuple[Link, int], ...] = ()
    listened: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ConfigError: the envelope, the header length or the version of MsgIds is unknown.
        """
        if self.msg_id_version not in {None, 1, 2}:
            raise ConfigError(f"MsgIds of version {self.msg_id_version} are not known; there are 1 and 2")
        if self.msg_id_version == 2 and (self.extended_header is False or self.telemetry_header == 12):
            raise ConfigError("MsgIds of version 2 need the extended header: name no other one")
        if self.telemetry_header not in {None, 12, 16}:
            raise ConfigError(
                f"telemetry header of {self.telemetry_header} bytes is not known; there are 12 and 16"
            )
        if self.envelope not in {None, "auto"}:
            EnvelopeFormat.of_name(str(self.envelope))
        cfe.MissionTime.of_text(self.time or "")

    @property
    def headers(self) -> cfe.Headers | None:
        """The headers of the options; None to detect them."""
        if self.msg_id_version == 2:
            return cfe.WITH_EXTENDED_2
        if self.extended_header:
            return cfe.WITH_EXTENDED
        if self.telemetry_header == cfe.SHORT.telemetry_bytes:
            return cfe.SHORT
        return None if self.extended_header is self.telemetry_header is None else cfe.STANDARD

    @property
    def msg_ids(self) -> MsgIds:
        """The rule that builds MsgIds; it is never detected."""
        return (self.headers or cfe.STANDARD).msg_ids

    def described(self) -> dict[str, str]:
        """Return the stated options, in the words of a recording; :meth:`over` reads them."""
        words = {} if self.headers is None else {"headers": self.headers.name}
        words |= {name: text for name in _KEPT if (text := getattr(self, name)) is not None}
        if self.ports:
            words["ports"] = " ".join(f"{link.label}:{port}" for link, port in self.ports)
        if self.listened:
            words["listened"] = " ".join(map(str, self.listened))
        return words

    def with_headers(self, headers: cfe.Headers) -> Options:
        """Return these options with the headers of a build."""
        return replace(
            self,
            extended_header=headers.extended,
            telemetry_header=headers.telemetry_bytes,
            msg_id_version=headers.msg_ids.version,
        )

    def saying(self, headers: Mapping[str, Any]) -> Options:
        """Return these options, with those of a mission file, by name, where these state nothing.

        Raises:
            ConfigError: the options contradict each other.
        """
        own = {name: value for name, value in headers.items() if getattr(self, name, 0) is None}
        return replace(self, **own).over({"ports": headers.get("ports", "")})

    def over(self, recorded: Mapping[str, str]) -> Options:
        """Return these options, with those of a recording where these state nothing."""
        kinds = {item.name: item for item in cfe.HEADERS}
        headers = kinds.get(recorded.get("headers", "")) if self.headers is None else None
        options = self
        if headers is not None:
            options = options.with_headers(headers)
        values: dict[str, Any] = {
            name: recorded[name] for name in _KEPT if getattr(self, name) is None and recorded.get(name)
        }
        links = {link.label: link for link in table.links()}
        pairs = [item.partition(":") for item in recorded.get("ports", "").split()]
        ports = [(links[name], int(port)) for name, _, port in pairs if name in links and port.isdecimal()]
        listened = [int(item) for item in recorded.get("listened", "").split() if item.isdecimal()]
        return replace(
            options,
            **values,
            ports=tuple(dict.fromkeys((*self.ports, *ports))),
            listened=tuple(dict.fromkeys((*self.listened, *listened))),
        )


class Context:
    """The lookups that both decoders share, compiled once from the mission and the options.

    Attributes:
        mission: mission whose routes are the indices in ``Columns.route``.
        types: ROS types, or None to leave CDR bodies undecoded.
        options: options of the decoder.
        structs: C structs in packets without a route.
        peers: SBN peers, which grow as datagrams are decoded, in order.
        endpoints: DDS endpoints, which grow as they announce themselves.
        look_ahead: reads the whole input for announcements in it; None if it cannot be read twice.
        spacecraft: spacecraft of the datagrams, which grow as well.
        by_magic: links that are recognised on any port.
        links: all links.
        frames: formats of CCSDS transfer frames, by the port that receives them.
        ports: UDP ports of each link, bool (65536,).
        claimants: sets of links that claim a port.
        claim: index into ``claimants`` by port, u8 (65536,).
        decided: link of each set of ``claimants`` if the port alone decides it, u8; else 0.
        by_sender: link of each set if the source port alone decides it, u8; else 0.
        stream_links: link whose TCP streams have a port at one end, u8 (65536,); 0 for none.
        framings: framing of TCP streams, by port.
        framed_links: link of packets from frames in streams, by the port of either end, u8 (65536,).
        with_headers: links whose datagrams do not begin with a space packet.
        header_bytes: bytes before the space packet, by link, i64 (256,).
        against: whether a packet goes in the wrong direction, by type bit and link, bool (2, 256).
        cfs_addresses: IPv4 addresses of the cFS of ground missions, as numbers.
        bridge_ports: ports of flight bridges, bool (65536,).
        identities: pairs (SpacecraftID, ProcessorID) in the mission.
        route_of: route by ``route_row[link]`` and MsgId, i16 (rows, 65536).
        route_row: row of ``route_of`` by link, u8 (256,); 0, an empty row, for links without routes.
        any_route_of: a route of any link by MsgId, i16 (65536,), for a packet seen on another link.
        known: MsgIds that cFE or the mission names, bool (65536,).
        in_packets: links whose units are carried in packets of other links.
        pdu_msg_ids: MsgIds of packets that each carry such a unit, i32.
        headers: headers after the primary header; :mod:`edoras_tools.decode.variants` may change them.
        msg_ids: rule that builds MsgIds; never detected.
        time: format of mission time in headers; :mod:`edoras_tools.decode.variants` may change it.
        builds: headers of conversations that have others than ``headers``.
        envelopes: envelope format of each route, None if each packet has its own.
        unrouted: envelope format of telemetry and of commands without a route.
        notes: detections from the bytes, one line each, for users.
        unnamed: number of datagrams left out that look like a link's, because no option names their port.
        described: words for the metadata of a recording that say how packets are read.
        command_table: commands of the apps, for columns.
    """

    def __init__(
        self,
        mission: Mission | None = None,
        types: TypeStore | None = None,
        options: Options | None = None,
        structs: Structs | None = None,
    ) -> None:
        self.mission = mission or Mission()
        self.types = types
        self.options = options or Options()
        self.headers = self.options.headers or cfe.STANDARD
        self.msg_ids = self.options.msg_ids
        self.time = cfe.MissionTime.of_text(self.options.time or "")
        structs = structs or shipped_structs(self.msg_ids, big_endian=self.mission.software.big_endian)
        structs = structs.under(self.mission.prefix(FIRST_SPACECRAFT))
        self.structs = structs.unclaimed(route.msg_id for route in self.mission.routes)
        self.peers = Peers()
        self.endpoints = Endpoints()
        self.look_ahead: Callable[[], Endpoints] | None = None
        self._announced: Endpoints | None = None
        self.links = table.links()
        self.in_packets = tuple(link for link in self.links if link.in_packets)
        self.by_magic = tuple(link for link in self.links if link.magic)
        self.frames = {item.port: item.format for item in self.mission.frames}
        self.ports = self._ports()
        self._settle_ports()
        self._settle_streams()
        self.with_headers = tuple(link for link in self.links if not link.packets or link.layouts)
        self.header_bytes = np.zeros(256, np.int64)
        self.against = np.zeros((2, 256), bool)
        for link in self.links:
            self.header_bytes[link] = link.header_bytes
            self.against[:, link] = link.to_cfs != link.from_cfs and [link.to_cfs, link.from_cfs]
        self._settle_bridges()
        self.spacecraft = Spacecraft(self.mission, self.links, self.bridge_ports)
        self._views: dict[int, Context] = {}
        self._settle_routes()
        self.notes: list[str] = []
        self.unnamed = 0
        self.described = self.options.described()
        apps = map(self.msg_ids.of_known, names.COMMANDS)
        listed = {*apps, *(route.msg_id for route in self.mission.routes)}
        self.command_table = CommandTable(
            {msg_id: commands for msg_id in listed if (commands := self.commands(msg_id)) is not None}
        )
        self.builds = Builds(self.structs, self.command_table, self.headers)

    def _settle_bridges(self) -> None:
        """Find the addresses, ports and identities of the mission's bridges and their cFS."""
        links = (link for link in self.mission.links if isinstance(link, GroundLink))
        addresses = (ipaddress.IPv4Address(link.fsw_ip) for link in links)
        # On one host, any of 127.0.0.0/8 may be anybody's, so such an address does not identify cFS.
        self.cfs_addresses = frozenset(int(item) for item in addresses if not item.is_loopback) - {0}
        self.bridge_ports = np.zeros(65536, bool)
        flights = [link for link in self.mission.links if isinstance(link, FlightLink)]
        self.bridge_ports[[link.udp_receive_port for link in flights] or [BRIDGE_PORT]] = True
        self.identities = frozenset(
            identity
            for link in flights
            for identity in (
                (link.spacecraft_id, link.processor_id),
                (link.peer_spacecraft_id, link.peer_processor_id),
            )
        )

    def _settle_routes(self) -> None:
        """Find the route of each MsgId by link, the known MsgIds, and the envelopes."""
        routed = sorted({int(route.link) for route in self.mission.routes})
        self.route_row = np.zeros(256, np.uint8)
        self.route_row[routed] = range(1, len(routed) + 1)
        self.route_of: NDArray[np.int16] = np.full((len(routed) + 1, 65536), NO_ROUTE, np.int16)
        self.any_route_of: NDArray[np.int16] = np.full(65536, NO_ROUTE, np.int16)
        self.known = np.zeros(65536, bool)
        self.known[[self.msg_ids.of_known(item) for item in names.MSG_ID_NAMES]] = True
        self.known |= self.structs.has[: len(self.known)]
        for index, route in reversed(list(enumerate(self.mission.routes))):
            self.route_of[self.route_row[route.link], route.msg_id] = index
            self.any_route_of[route.msg_id] = index
            self.known[route.msg_id] = True
        self.pdu_msg_ids = np.array(self.mission.pdu_msg_ids if self.in_packets else (), np.int32)
        self.known[self.pdu_msg_ids] = True
        self.route_of[:, self.pdu_msg_ids] = self.any_route_of[self.pdu_msg_ids] = NO_ROUTE
        usual = "" if self.options.envelope == "auto" else self.options.envelope
        self.unrouted = [EnvelopeFormat.of_name(usual) if usual else DEFAULT] * 2
        envelopes = [route.envelope or self.options.envelope or str(DEFAULT) for route in self.mission.routes]
        self.envelopes = [None if text == "auto" else EnvelopeFormat.of_name(text) for text in envelopes]

    def of(self, spacecraft: int) -> Context:
        """Return this context for a spacecraft: its topics have the spacecraft's prefix."""
        if self.mission.prefix(spacecraft) == self.mission.prefix(FIRST_SPACECRAFT):
            return self
        if spacecraft not in self._views:
            self._views[spacecraft] = _View(self, spacecraft)
        return self._views[spacecraft]

    def in_order(self, layout: Layout) -> Layout:
        """Return the layout of a payload, or of telemetry's header, in the flight computer's byte order."""
        if layout.name == cfe.TELEMETRY.name:
            return self.time.layout(layout)
        return layout.big if self.structs.big_endian else layout

    def routes_on(self, link: Link) -> NDArray[np.int16]:
        """Return the route of each MsgId on a link, i16 (65536,); ``NO_ROUTE`` if there is none."""
        return self.route_of[self.route_row[link]]

    @property
    def detected(self) -> tuple[Any, ...]:
        """The detections from the bytes that decide how packets are read, for ``take_over``."""
        place = cfe.HEADERS.index(self.headers)
        return place, tuple(self.envelopes), tuple(self.unrouted), self.builds.state, self.time

    def announced_topics(self) -> dict[str, str]:
        """Return the type of each topic that the whole input announces, if it can be read twice."""
        if self.look_ahead is not None:
            self._announced, self.look_ahead = self.look_ahead(), None
        return (self._announced or self.endpoints).topics()

    @property
    def awaits_samples(self) -> bool:
        """Whether topics may be announced while the input is read, and cannot be looked up before."""
        has_port = any(link in self.by_magic for link, _ in self.options.ports)
        return has_port and self.look_ahead is None and self._announced is None

    def take_over(self, detected: tuple[Any, ...]) -> None:
        """Read packets like another context, of another process; ``detected`` is that context's."""
        place, envelopes, unrouted, builds, self.time = detected
        self.headers = cfe.HEADERS[place]
        self.envelopes, self.unrouted = [*envelopes], [*unrouted]
        self.builds.take_over(builds)

    def capture_ports(self) -> tuple[int, ...]:
        """Return every UDP port of a link, for a filter in the kernel, except 0, the port of files."""
        return tuple(int(port) for port in np.flatnonzero(self.claim) if port)

    def capture_begins(self) -> tuple[bytes, ...]:
        """Return the first bytes of datagrams that are captured on any port."""
        return tuple(link.magic for link in self.by_magic if (link, 0) in self.options.ports)

    def is_cfs(self, endpoint: Endpoint) -> bool:
        """Return whether an endpoint's address is that of a cFS in a ground mission."""
        return (
            ":" not in endpoint.address and int(ipaddress.IPv4Address(endpoint.address)) in self.cfs_addresses
        )

    def name(self, msg_id: int) -> str:
        """Return the name of packets of a MsgId: cFE's name, else a route's topic or a struct's name."""
        route = int(self.any_route_of[msg_id])
        topic = self.mission.routes[route].topic if route != NO_ROUTE else ""
        pdu = f"{self.in_packets[0].name}_PDU" if msg_id in self.pdu_msg_ids else ""
        return names.message_name(self.msg_ids.standard(msg_id)) or topic or pdu or self.structs.name(msg_id)

    def commands(self, msg_id: int) -> Mapping[int, names.Command] | None:
        """Return the function codes that a command MsgId's app accepts, or None if they are unknown."""
        plain = self.msg_ids.standard(msg_id)
        if plain in names.COMMANDS:
            return names.COMMANDS[plain]
        if self.any_route_of[msg_id] != NO_ROUTE and self.msg_ids.is_command(msg_id):
            return names.ROUTE_COMMANDS
        return None

    def _ports(self) -> dict[Link, Mask]:
        ports: dict[Link, Mask] = {link: np.zeros(65536, bool) for link in self.links}
        for link, claimed in ((link, claimed) for link, claimed in ports.items() if link.transport.udp):
            claimed[[port for other, port in self.options.ports if other == link and port]] = True
            if link.last_hop:
                claimed[[port for port, _ in self.structs.ports]] = True
            for bridge in self.mission.links:
                if bridge.kind == link.bridge:
                    claimed[[getattr(bridge, name) for name in link.bridge_ports]] = True
        listed = np.any(list(ports.values()), axis=0)
        for link in self.links:
            if link.transport.udp:
                # A link that is recognised by content leaves its usual ports to a link named for them.
                usual = [port for port in link.transport.ports if link.port_decides or not listed[port]]
                ports[link][usual] = True
        for framed in self.mission.frames:  # no other link's packets are in the frames
            for link, claimed in ports.items():
                claimed[framed.port] = link == framed.link
        return ports

    def _settle_streams(self) -> None:
        """Find the link of the TCP streams of each port; ports named by options come first."""
        usual = [(link, port) for link in self.links for port in link.transport.ports]
        self.stream_links: Octets = np.zeros(65536, np.uint8)
        for link, port in reversed([*self.options.ports, *usual]):
            if link != OTHER and table.protocol(link).framing is not None:
                self.stream_links[port] = link
        self.framed_links: Octets = np.zeros(65536, np.uint8)
        self.framings = table.framings(self.options.ports)
        for framed in self.mission.frames:
            if framed.format.stream:
                pairs = ((link, link.framing_of(framed.link, framed.format)) for link in self.links)
                cut = {link: framing for link, framing in pairs if framing is not None}
                owner = framed.link if framed.link in cut else next(iter(cut), OTHER)
                if owner in cut:
                    self.framings[framed.port] = cut[table.protocol(owner)]
                self.stream_links[framed.port] = owner if owner == framed.link else OTHER
                self.framed_links[framed.port] = framed.link

    def _settle_ports(self) -> None:
        """Find the sets of links that claim a port, and the link that the port alone decides for each set."""
        sets: dict[tuple[LinkProtocol, ...], int] = {(): 0}
        self.claim: Octets = np.zeros(65536, np.uint8)
        for port in np.flatnonzero(np.any(list(self.ports.values()), axis=0)).tolist():
            links = tuple(link for link in self.links if self.ports[link][port])
            self.claim[port] = sets.setdefault(links, len(sets))
        self.claimants = tuple(sets)
        self.decided = np.zeros(len(sets), np.uint8)
        self.by_sender = np.zeros(len(sets), np.uint8)
        for index, links in enumerate(self.claimants):
            if len(links) == 1 and links[0].port_decides:
                self.decided[index] = links[0]
            self.by_sender[index] = next((link for link in links if link.sender_port), OTHER)


class _View(Context):
    """A context for another spacecraft than the first: only the names of topics differ."""

    def __init__(self, whole: Context, number: int) -> None:
        self._whole = whole
        self.mission = whole.mission.of(number)
        self.structs = whole.structs.under(whole.mission.prefix(number))

    def __getattr__(self, name: str) -> Any:
        if name[:2] == "__" or name == "_whole":  # requested before it is set, for example by ``copy``
            raise AttributeError(name)
        return getattr(self._whole, name)
