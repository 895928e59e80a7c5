"""The messages of an emulated system: those of a demo, or those in a mission file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.messages import JOINT_STATE, POSE, POSE_STAMPED, TWIST
from edoras_tools.cfs.profile import FLIGHT_BRIDGE, TO_TABLE, SbnPeerConfig, SimProfile
from edoras_tools.errors import ConfigError
from edoras_tools.model import Peer
from edoras_tools.wire.envelope import DEFAULT, EnvelopeFormat

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from edoras_tools.mission import Bridge, Route
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.ros import TypeStore

Scenario = Literal["rover", "arm", "two-rovers", "two-arms"]


class SystemRoutes(msgspec.Struct, frozen=True):
    """MsgIds on the bus, with types and envelopes.

    Attributes:
        types: MsgId to ROS type.
        commands: MsgIds of commands from the ground; the first belongs to the application's own robot.
        telemetry: MsgIds of telemetry to the ground.
        states: MsgIds of the states of robots on SBN, in the order of ``telemetry``.
        flight: MsgIds of commands to robots on SBN, in the order of ``commands``.
        envelopes: MsgId to its envelope, if it is not the usual one.
        bridge: SBN identity of the flight bridge.
        store: types; None for those of the demos.
    """

    types: Mapping[int, str]
    commands: Sequence[int]
    telemetry: Sequence[int]
    states: Sequence[int] = ()
    flight: Sequence[int] = ()
    envelopes: Mapping[int, EnvelopeFormat] = msgspec.field(default_factory=dict)
    bridge: Peer = FLIGHT_BRIDGE
    store: TypeStore | None = None

    def envelope(self, msg_id: int) -> EnvelopeFormat:
        """Return the envelope of a MsgId."""
        return self.envelopes.get(msg_id, DEFAULT)


def _demo(command_type: str, state_type: str, *, two: bool) -> SystemRoutes:
    commands, telemetry, states, flight = [0x1827], [0x0827], list[int](), list[int]()
    if two:
        commands, telemetry = [0x1827, 0x1828], [0x0828, 0x0829]
        states, flight = [0x1829, 0x182A], [0x082A, 0x082B]
    types = dict.fromkeys([*commands, *flight], command_type) | dict.fromkeys(
        [*telemetry, *states], state_type
    )
    return SystemRoutes(types, commands, telemetry, states, flight)


DEMO_ROUTES: Final[Mapping[Scenario, SystemRoutes]] = {
    "rover": _demo(TWIST, POSE_STAMPED, two=False),
    "arm": _demo(POSE, JOINT_STATE, two=False),
    "two-rovers": _demo(TWIST, POSE_STAMPED, two=True),
    "two-arms": _demo(POSE, JOINT_STATE, two=True),
}


def routes_of(bench: Workbench) -> SystemRoutes:
    """Return the messages of a mission: those of its first bridge of each kind.

    Raises:
        ConfigError: its ground bridge has no topic, or there is none.
    """
    mission, standard = bench.mission, bench.mission.msg_ids.standard
    groups = [
        routes_of_kind(mission.bridges, kind, to_cfs=to_cfs)
        for kind in ("ground", "flight")
        for to_cfs in (True, False)
    ]
    if not groups[0] and not groups[1]:
        raise ConfigError("the mission has no ground bridge with a topic: sim has nothing to emulate")
    routes = [item for group in groups for item in group]
    forms = dict(zip(mission.routes, bench.columns.context.envelopes, strict=True))
    ids = [[standard(item.msg_id) for item in group] for group in groups]
    return SystemRoutes(
        {standard(item.msg_id): item.type for item in routes},
        commands=ids[0],
        telemetry=ids[1],
        states=ids[2][: len(ids[1])],
        flight=ids[3][: len(ids[0])],
        envelopes={standard(item.msg_id): forms.get(item) or DEFAULT for item in routes},
        bridge=next((Peer(own.spacecraft_id, own.processor_id) for own in mission.flight), FLIGHT_BRIDGE),
        store=bench.types,
    )


def routes_of_kind(bridges: Sequence[Bridge], kind: str, *, to_cfs: bool) -> list[Route]:
    """Return the routes in one direction of the first bridge of a kind, ``ground`` or ``flight``."""
    bridge = next((item for item in bridges if item.link.kind == kind), None)
    return [item for item in bridge.routes if item.to_cfs == to_cfs] if bridge else []


def mission_profile(bench: Workbench) -> SimProfile:
    """Return the constants of a mission's cFS, with ports and SBN peers of the first bridge of each kind."""
    mission, profile = bench.mission, bench.mission.software.profile
    ports: dict[str, Any] = {}
    for ground in mission.ground[:1]:
        ports |= {"ci_port": ground.fsw_port, "to_port": ground.bridge_port}
    for flight in mission.flight[:1]:
        bridge = SbnPeerConfig(Peer(flight.spacecraft_id, flight.processor_id), flight.udp_receive_port)
        profile = replace(profile, sbn_peers=(bridge,))
        ports["sbn_port"] = flight.peer_port
    headers = bench.columns.context.headers
    return replace(
        profile,
        **{name: port for name, port in ports.items() if name not in profile.stated},
        headers=headers,
        time=bench.columns.context.time,
    )


def with_limit(profile: SimProfile, limit: int) -> SimProfile:
    """Return constants with ``limit`` for each MsgId at TO whose limit is the usual one and not stated."""
    usual = SimProfile().to_default_limit
    limits = {msg_id: limit if room == usual else room for msg_id, room in TO_TABLE.items()}
    limits |= {msg_id: room for msg_id, room in profile.to_limits.items() if msg_id in profile.stated}
    return replace(profile, to_default_limit=limit, to_limits=limits)
