"""The highest rate that each route can carry, from the mission and the constants of cFS alone.

This is ``doctor --predict``. ``limit`` is also what verdicts and accounts assume of a link whose pipes
nothing shows.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec
from msgspec.structs import replace

from edoras_tools.cfs import queues
from edoras_tools.cfs.edoras_app import BRIDGE_BUFFER, BRIDGE_LENGTH_MODULUS
from edoras_tools.mission.model import FlightLink
from edoras_tools.model import Link, Peer
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat
from edoras_tools.wire.sbn import HEADER

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.mission import Mission, Route
    from edoras_tools.ros import TypeStore

_HOUSEKEEPING_HZ: Final = 10
"""Housekeeping that shares Telemetry Output's pipe."""
_ANY: Final = "0.0.0.0"  # noqa: S104  an address in a mission file


class Budget(msgspec.Struct, frozen=True):
    """What a route can carry.

    Attributes:
        route: the route.
        limit_hz: messages a second that get through without loss, evenly sent.
        hop: where the limit is.
        reason: why.
        bytes: UDP payload of its messages; None where they vary.
        traps: what its size runs into, a line each.
    """

    route: Route
    limit_hz: float
    hop: str
    reason: str
    bytes: int | None
    traps: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """Return it in the shape of ``doctor --predict --json``."""
        return {
            "topic": self.route.topic,
            "type": self.route.type,
            "link": self.route.link.label,
            "msg_id": f"0x{self.route.msg_id:04x}",
            "direction": self.route.direction,
            **{name: getattr(self, name) for name in ("limit_hz", "hop", "reason", "bytes")},
            "traps": list(self.traps),
        }


def predict(
    mission: Mission, types: TypeStore, profile: SimProfile, headers: cfe.Headers = cfe.STANDARD
) -> list[Budget]:
    """Return the budget of every route of a mission, for a cFE with some headers."""
    unlisted = {
        route: _unlisted(bridge.link, profile)
        for bridge in mission.bridges
        if isinstance(bridge.link, FlightLink) and profile.sbn_table
        for route in bridge.routes
    }
    budgets = [_budget(route, types, profile, headers) for route in mission.routes]
    return [replace(item, traps=(*item.traps, *unlisted.get(item.route, ()))) for item in budgets]


def _unlisted(link: FlightLink, profile: SimProfile) -> tuple[str, ...]:
    """Return what SBN's table has not, or otherwise, of what a flight bridge says of itself."""
    table = {item.peer: item for item in profile.sbn_table}
    bridge = Peer(link.spacecraft_id, link.processor_id)
    if bridge not in table:
        return (f"SBN's table has no peer {bridge}: cFS refuses what the bridge sends",)
    place = table[bridge]
    ends = (link.udp_receive_ip, link.udp_receive_port)
    if place.port != ends[1] or (ends[0] != _ANY and place.address != ends[0]):
        where = f"{place.address}:{place.port}"
        return (f"SBN's table has {bridge} at {where}, and the bridge listens at {ends[0]}:{ends[1]}",)
    return ()


class RouteLimit(NamedTuple):
    """The highest clean rate of a MsgId on a link.

    Attributes:
        hz: messages a second that get through without loss, evenly sent; 0 if nothing limits them.
        hop: where the limit is.
        reason: why.
        constants: names of the constants of cFS that it follows from, and MsgIds.
    """

    hz: float
    hop: str
    reason: str
    constants: tuple[str | int, ...]


def limit(link: Link, msg_id: int, profile: SimProfile, *, to_cfs: bool) -> RouteLimit:
    """Return the highest clean rate of a MsgId on a link."""
    constants: tuple[str | int, ...]
    if link.only_to_cfs:
        pipe, socket = queues.application_pipe(profile), queues.ci_socket(profile)
        most, hop, constants = pipe.usual_limit, "application pipe", ("ci_wake_ns", "app_msg_limit")
        text = "the application's pipe takes {} of one MsgId, and CI delivers every {} ms"
        text += f" ({socket.rate_hz(socket.reads):g}/s of all together)"
    elif link.only_from_cfs:
        pipe, hop, constants = queues.telemetry_pipe(profile), "TO_LAB_TLM_PIPE", ("to_wake_ns", msg_id)
        room = pipe.depth - _HOUSEKEEPING_HZ * pipe.round_ns // SECOND
        most = min(pipe.limit(msg_id), room)
        text = "Telemetry Output's table lets {} of the MsgId wait, and TO sends every {} ms"
        if most == room:
            text = "Telemetry Output's pipe has room for {} beside housekeeping, and TO sends every {} ms"
    elif not to_cfs:
        pipe, constants = queues.peer_pipe(profile), ("sbn_wake_ns", "sbn_msg_limit")
        most, hop = pipe.usual_limit, "SBN peer pipe"
        text = "the SBN peer's pipe takes {} of one MsgId, and SBN serves it every {} ms"
    else:
        hop, constants = "application pipe", ("sbn_wake_ns", "app_msg_limit")
        if not profile.sbn_polls:
            text = "SBN delivers at once: no limit but the application's own speed; 20/s where SBN polls"
            return RouteLimit(0.0, hop, text, constants)
        pipe = queues.application_pipe(profile, over_network=True)
        most = pipe.usual_limit
        text = "the application's pipe takes {} of one MsgId, and SBN polls every {} ms"
    return RouteLimit(pipe.rate_hz(most), hop, text.format(most, pipe.round_ns // 1_000_000), constants)


def _budget(route: Route, types: TypeStore, profile: SimProfile, headers: cfe.Headers) -> Budget:
    limit_hz, hop, reason, _ = limit(route.link, route.msg_id, profile, to_cfs=route.to_cfs)
    fixed = types.fixed_size(route.type) if types.has(route.type) else None
    size = None
    if fixed is not None:
        envelope = route.envelope if route.envelope and route.envelope != "auto" else str(DEFAULT)
        network = HEADER.size if route.link.peers else 0
        size = network + headers.size(route.msg_id) + EnvelopeFormat.of_name(envelope).size + fixed
    command = headers.msg_ids.is_command(route.msg_id)
    return Budget(route, limit_hz, hop, reason, size, tuple(_traps(route, size, profile, command=command)))


def _traps(route: Route, size: int | None, profile: SimProfile, *, command: bool) -> list[str]:
    if command and route.link.only_from_cfs:
        return [f"0x{route.msg_id:04x} is a command MsgId: TO carries telemetry"]
    if not command and route.link.only_to_cfs:
        return [f"0x{route.msg_id:04x} is a telemetry MsgId: applications take commands from CI"]
    if size is None:
        return []
    traps = []
    if route.link.only_to_cfs and size > profile.ci_buffer:
        traps.append(f"{size} bytes: CI cuts at {profile.ci_buffer}, silently")
    if route.link.only_from_cfs and size > BRIDGE_BUFFER:
        traps.append(f"{size} bytes: the ground bridge receives {BRIDGE_BUFFER}")
    if route.link.peers and not route.to_cfs and size % BRIDGE_LENGTH_MODULUS < HEADER.size:
        traps.append(f"{size} bytes: {size} mod 256 is below 11, the public flight bridge drops it")
    return traps
