"""What a decode needs to know besides the bytes: the mission, the options and who has spoken so far."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.mission import FlightLink, GroundLink, Mission
from edoras_tools.model import NO_ROUTE, Link
from edoras_tools.structs import Structs, shipped
from edoras_tools.wire import cfe, names
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from edoras_tools.model import Endpoint
    from edoras_tools.ros import TypeStore

CI_PORTS: Final = (1234, 1235, 1236, 1237)
"""1234 + (CPU number - 1)."""
TO_PORTS: Final = (1235,)
SBN_PORTS: Final = (2234, 2235, 2236)
BRIDGE_PORT: Final = 2236
"""Where the demos' flight bridge listens."""


@dataclass(frozen=True, slots=True)
class Options:
    """How to read what the bytes do not say themselves.

    Attributes:
        extended_header: packets carry cFE's extended ("version 2") header.
        telemetry_header: bytes of the telemetry header, primary header included: 16, or 12 in older builds.
        envelope: format of every route that names none: ``8/8`` and the like, or ``auto``.
        ports: further UDP ports by link.
    """

    extended_header: bool = False
    telemetry_header: int = cfe.TELEMETRY_HEADER_BYTES
    envelope: str = str(DEFAULT)
    ports: tuple[tuple[Link, int], ...] = ()

    def __post_init__(self) -> None:
        """Check once.

        Raises:
            ConfigError: the envelope or the header length is not known.
        """
        if self.telemetry_header not in {12, 16}:
            raise ConfigError(
                f"telemetry header of {self.telemetry_header} bytes is not known; there are 12 and 16"
            )
        if self.envelope != "auto":
            EnvelopeFormat.named(self.envelope)


class Peers:
    """Who speaks from where on the Software Bus Network: the first identity an endpoint gives is its own.

    Peers are told apart by identity, never by address; a second identity from one endpoint is what a receiver
    reports as an unknown peer.
    """

    def __init__(self) -> None:
        self._first: dict[tuple[str, int], tuple[tuple[int, int], int]] = {}

    def introduce(self, endpoint: tuple[str, int], identity: tuple[int, int], number: int) -> tuple[int, int]:
        """Return the identity an endpoint is known by, which is this one if it has none yet.

        Args:
            endpoint: address as text and port.
            identity: SpacecraftID and ProcessorID.
            number: of the datagram that gives it.
        """
        return self._first.setdefault(endpoint, (identity, number))[0]

    def known(self, endpoint: tuple[str, int], number: int) -> tuple[int, int] | None:
        """Return the identity an endpoint was known by when a datagram came, or None."""
        identity, since = self._first.get(endpoint, ((0, 0), number + 1))
        return identity if since <= number else None


class CommandTable:
    """What apps take, as arrays: for many commands at once.

    Args:
        commands: function codes and their commands by MsgId.
    """

    def __init__(self, commands: Mapping[int, Mapping[int, names.Command]]) -> None:
        self._app = np.zeros(65536, np.uint8)
        self._taken = np.zeros((len(commands) + 1, 128), bool)
        self._lengths = np.zeros((2, len(commands) + 1, 128), np.int32)
        for app, (msg_id, codes) in enumerate(commands.items(), 1):
            self._app[msg_id] = app
            for code, command in codes.items():
                self._taken[app, code] = True
                for choice, length in enumerate(
                    command.lengths * 2 if len(command.lengths) == 1 else command.lengths
                ):
                    self._lengths[choice, app, code] = length

    def judge(
        self, msg_id: NDArray[np.int32], code: NDArray[np.int16], length: NDArray[np.int32]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Tell which commands have a function code that their app refuses, and which have a wrong length."""
        app = self._app[msg_id]
        one, other = self._lengths[:, app, code]
        unknown: NDArray[np.bool_] = (app != 0) & ~self._taken[app, code]
        misfit: NDArray[np.bool_] = (one != 0) & (length != one) & (length != other)
        return unknown, misfit


class Context:
    """The lookups that both decoders share, compiled once from the mission and the options.

    Attributes:
        mission: its routes give ``Columns.route`` its meaning.
        types: the ROS types, or None to leave CDR bodies alone.
        options: as given.
        structs: the C structs that packets without a route hold.
        peers: grows as datagrams are decoded, in order.
        port_links: u8 (65536,), bit ``1 << link`` for every link that a UDP port may belong to.
        cfs_addresses: IPv4 addresses of the cFS of ground missions, as numbers.
        bridge_ports: bool (65536,), ports of flight bridges.
        identities: (SpacecraftID, ProcessorID) that missions name.
        route_of: i16 (4, 65536), route by link and MsgId.
        any_route_of: i16 (65536,), a route of any link by MsgId: what a packet seen on another link carries.
        known: bool (65536,), MsgIds that cFE or the mission names.
        envelopes: the envelope format of each route, None where the bytes shall tell.
        command_table: what apps take, for columns.
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
        self.structs = (structs or shipped()).unclaimed(route.msg_id for route in self.mission.routes)
        self.peers = Peers()
        self.port_links = self._ports()
        self.cfs_addresses = frozenset(
            int(ipaddress.IPv4Address(link.fsw_ip))
            for link in self.mission.links
            if isinstance(link, GroundLink)
        ) - {0}
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
        self.route_of: NDArray[np.int16] = np.full((len(Link), 65536), NO_ROUTE, np.int16)
        self.any_route_of: NDArray[np.int16] = np.full(65536, NO_ROUTE, np.int16)
        self.known = np.zeros(65536, bool)
        self.known[list(names.MSG_ID_NAMES)] = True
        self.known |= self.structs.has
        for index, route in reversed(list(enumerate(self.mission.routes))):
            self.route_of[route.link, route.msg_id] = index
            self.any_route_of[route.msg_id] = index
            self.known[route.msg_id] = True
        chosen = [route.envelope or self.options.envelope for route in self.mission.routes]
        self.envelopes = [None if text == "auto" else EnvelopeFormat.named(text) for text in chosen]
        named = {*names.COMMANDS, *(route.msg_id for route in self.mission.routes)}
        self.command_table = CommandTable(
            {msg_id: commands for msg_id in named if (commands := self.commands(msg_id)) is not None}
        )

    def capture_ports(self) -> tuple[int, ...]:
        """Return every UDP port that belongs to a link, for a filter in the kernel."""
        return tuple(int(port) for port in np.flatnonzero(self.port_links))

    def is_cfs(self, endpoint: Endpoint) -> bool:
        """Tell whether an endpoint's address is that of a cFS that a ground mission names."""
        return (
            ":" not in endpoint.address and int(ipaddress.IPv4Address(endpoint.address)) in self.cfs_addresses
        )

    def commands(self, msg_id: int) -> Mapping[int, names.Command] | None:
        """Return the function codes a command MsgId's app takes, or None where that is not known."""
        if msg_id in names.COMMANDS:
            return names.COMMANDS[msg_id]
        if self.any_route_of[msg_id] != NO_ROUTE and cfe.is_command(msg_id):
            return names.ROUTE_COMMANDS
        return None

    def _ports(self) -> NDArray[np.uint8]:
        ports = np.zeros(65536, np.uint8)
        claims = [(Link.CI, port) for port in CI_PORTS]
        claims += [(Link.TO, port) for port in TO_PORTS]
        claims += [(Link.SBN, port) for port in SBN_PORTS]
        claims += self.options.ports
        for link in self.mission.links:
            if isinstance(link, GroundLink):
                claims += [(Link.CI, link.fsw_port), (Link.TO, link.bridge_port)]
            else:
                claims += [(Link.SBN, link.peer_port), (Link.SBN, link.udp_receive_port)]
        for kind, port in claims:
            ports[port] |= 1 << kind
        return ports
