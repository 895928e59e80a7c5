"""Describes the packets of a mission for ground systems."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from edoras_tools.cfs import edoras_app
from edoras_tools.codegen.ground.cosmos import cosmos
from edoras_tools.codegen.ground.packets import PacketItem, route_packet, struct_packet
from edoras_tools.codegen.ground.xtce import xtce
from edoras_tools.errors import ConfigError
from edoras_tools.structs.packets import PACKETS, UDP_KEY
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Workbench


@dataclass(frozen=True, slots=True)
class GroundDescription:
    """What was written, and what it lacks.

    Attributes:
        text: the description.
        telemetry: packets from cFS in it.
        commands: packets to cFS in it.
        notes: what is left out, a line each.
    """

    text: bytes
    telemetry: int
    commands: int
    notes: list[str] = field(default_factory=list)


def describe_packets(
    bench: Workbench, name: str = "edoras", *, for_cosmos: bool = False
) -> GroundDescription:
    """Describe the packets that CI and TO carry: those of the mission's routes, and of known C structs.

    Args:
        bench: the mission, its types and its structs.
        name: of the space system, or the target.
        for_cosmos: for COSMOS, instead of XTCE.

    Raises:
        ConfigError: MsgIds are of version 2, or a mission names two topics alike.
    """
    context = bench.columns.context
    headers = context.options.headers or cfe.STANDARD
    if context.msg_ids.command_bit != cfe.STANDARD.msg_ids.command_bit:
        raise ConfigError("packets are told by their APID, which MsgIds of version 2 share; use version 1")
    notes: list[str] = []
    telemetry, commands = [], []
    routes = [route for route in bench.mission.routes if not route.link.peers]
    packets = [(route_packet(route, bench.types, edoras_app.SET), route.to_cfs) for route in routes]
    for bound in context.structs.all:
        key = bound.key
        if key.msg_id >= UDP_KEY:  # a robot's datagram, an entry of F Prime: no space packet of cFE
            continue
        to_cfs = context.msg_ids.is_command(key.msg_id)
        if to_cfs and key.function_code is None:
            notes.append(f"{key}, {bound.name}: no command is described: bind {key}/CODE, its function code")
        elif to_cfs or key.function_code is None:
            packets.append((struct_packet(bound), to_cfs))
    for packet, to_cfs in packets:
        fixed = packet.whole and all(isinstance(item, PacketItem) for item in packet.items)
        if to_cfs and fixed:
            commands.append(packet)
        elif to_cfs:
            notes.append(f"{packet.doc}: no command is described: its size varies")
        else:
            telemetry.append(packet)
            if not packet.whole and packet.msg_id not in PACKETS:
                notes.append(f"{packet.doc}: described up to a field whose place varies too much")
    text = (cosmos if for_cosmos else xtce)(name, telemetry, commands, headers)
    return GroundDescription(text, len(telemetry), len(commands), notes)
