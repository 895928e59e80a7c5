"""The four demonstrations of the EDORAS paper: their files on ports that are free, and who is who in them."""

from __future__ import annotations

import re
import socket
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.mission import GroundLink
from edoras_tools.sessions.profile import SbnPeerConfig, SimProfile
from edoras_tools.wire.sbn import Peer

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from edoras_tools.mission import Bridge, Route
    from edoras_tools.sim import Scenario

HOST: Final = "127.0.0.1"
FILES: Final = {
    "rover": ("rover_ground",),
    "arm": ("single_arm_ground",),
    "two-rovers": ("two_rovers_ground", "two_rovers_flight"),
    "two-arms": ("two_arms_ground", "two_arms_flight"),
}
LAYOUTS: Final = {
    "rover": "foxglove_layout_rover",
    "arm": "foxglove_layout_arm",
    "two-rovers": "foxglove_layout",
    "two-arms": "foxglove_layout_two_arms",
}
_FLIGHT: Final = Peer(0x42, 3)
_TO_LIMIT: Final = 20
"""Packets of one state that may wait in Telemetry Output: 30 Hz for half a second, and some more."""


@dataclass(frozen=True, slots=True)
class Ports:
    """UDP ports of one demo, all on loopback.

    Attributes:
        ci: Command Ingest.
        to: the ground bridge, where Telemetry Output sends.
        sbn: cFS's Software Bus Network.
        peer: the flight bridge.
    """

    ci: int
    to: int
    sbn: int
    peer: int


@dataclass(frozen=True, slots=True)
class Lane:
    """One robot and its four topics.

    Attributes:
        robot: its name.
        command: on the ground, to cFS.
        state: on the ground, from cFS.
        board_command: at the robot; None where it hangs on the flight application.
        board_state: likewise.
    """

    robot: str
    command: Route
    state: Route
    board_command: Route | None = None
    board_state: Route | None = None


def free_ports() -> Ports:
    """Return ports that nobody has.

    They are not the usual ones: whoever sends to those would be heard here too.

    Raises:
        CaptureError: the system has none.
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(4)]
        try:
            for item in opened:
                item.bind((HOST, 0))
        except OSError as error:
            raise CaptureError(f"{HOST}: no free UDP port: {error.strerror or error}") from None
        return Ports(*(item.getsockname()[1] for item in opened))


def profile(ports: Ports, states: Iterable[int]) -> SimProfile:
    """Return a cFS on these ports, the flight bridge its peer, with room for the states in TO's table.

    Args:
        ports: where it is.
        states: MsgIds of the states that go to the ground.
    """
    usual = SimProfile()
    return replace(
        usual,
        address=HOST,
        ci_port=ports.ci,
        to_port=ports.to,
        sbn_port=ports.sbn,
        sbn_peers=(SbnPeerConfig(_FLIGHT, ports.peer, HOST),),
        to_limits={**usual.to_limits, **dict.fromkeys(states, _TO_LIMIT)},
    )


def write_missions(scenario: Scenario, folder: Path, ports: Ports, max_rate: float) -> list[Path]:
    """Write a demo's files.

    Args:
        scenario: which demo.
        folder: where to.
        ports: put in the place of the usual ones.
        max_rate: states a second and robot that the flight bridge lets through; 0 for all.

    Raises:
        CaptureError: they cannot be written.
    """
    samples = files("edoras_tools.samples")
    paths = []
    for name in FILES[scenario]:
        text = (
            (samples / f"missions/{name}.yaml").read_text(encoding="utf-8").replace('"0.0.0.0"', f'"{HOST}"')
        )
        for key, port in (
            ("bridge_port", ports.to),
            ("fsw_port", ports.ci),
            ("peer_port", ports.sbn),
            ("udp_receive_port", ports.peer),
        ):
            text = re.sub(rf"\b{key}: \d+", f"{key}: {port}", text)
        if max_rate and name.endswith("flight"):
            group = (
                f"    edoras: # read by edoras bridge only\n      max_rate: {max_rate:g}\n      keep: first\n"
            )
            text = text.replace("  ros__parameters:\n", f"  ros__parameters:\n{group}\n")
        path = folder / f"{name}.yaml"
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            raise CaptureError(f"{path}: {error.strerror or error}") from None
        paths.append(path)
    return paths


def lanes_of(scenario: Scenario, bridges: Iterable[Bridge]) -> tuple[Lane, ...]:
    """Return the robots of a demo, from its bridges."""
    commands: list[Route] = []
    states: list[Route] = []
    board_commands: list[Route] = []
    board_states: list[Route] = []
    for bridge in bridges:
        ground = isinstance(bridge.link, GroundLink)
        for route in bridge.routes:
            if ground:
                (commands if route.to_cfs else states).append(route)
            else:
                (board_states if route.to_cfs else board_commands).append(route)
    if not board_states:
        return tuple(Lane(scenario, *pair) for pair in zip(commands, states, strict=True))
    rows = zip(commands, states, board_commands, board_states, strict=True)
    return tuple(Lane(row[0].topic.split("/")[1], *row) for row in rows)
