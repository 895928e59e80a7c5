"""Describes the packets of a mission for ground systems."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from edoras_tools.cfs import edoras_app
from edoras_tools.codegen.ground.cosmos import cosmos
from edoras_tools.codegen.ground.packets import PacketItem, route_packet, struct_packet
from edoras_tools.codegen.ground.xtce import xtce
from edoras_tools.errors import ConfigError
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.codegen.ground.packets import GroundPacket
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
    for route in bench.mission.routes:
        if route.link.peers:
            continue
        packet = route_packet(route, bench.types, edoras_app.SET)
        if not packet.whole:
            notes.append(f"{packet.doc}: described up to a field whose place varies too much")
        if not route.to_cfs:
            telemetry.append(packet)
        elif all(isinstance(item, PacketItem) for item in packet.items) and packet.whole:
            commands.append(packet)
        else:
            notes.append(f"{packet.doc}: no command is described: its size varies")
    routed = {packet.msg_id for packet in telemetry}
    telemetry += [packet for packet in _structs(bench) if packet.msg_id not in routed]
    text = (cosmos if for_cosmos else xtce)(name, telemetry, commands, headers)
    return GroundDescription(text, len(telemetry), len(commands), notes)


def _structs(bench: Workbench) -> Iterator[GroundPacket]:
    """Yield the telemetry packets that hold a known C struct, each MsgId once."""
    seen: set[int] = set()
    for layout in bench.columns.context.structs.layouts:
        for key in sorted(layout.bindings):
            if key.port is None and key.function_code is None and key.msg_id not in seen:
                seen.add(key.msg_id)
                if not cfe.STANDARD.msg_ids.is_command(key.msg_id):
                    yield struct_packet(key, layout)
