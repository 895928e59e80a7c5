"""The four demonstrations of the EDORAS paper: their mission files, with free ports, and their topics."""

from __future__ import annotations

import re
from contextlib import ExitStack
from importlib.resources import files
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator import MISSIONS, Scenario
from edoras_tools.addons.lab.emulator.routes import routes_of_kind
from edoras_tools.cfs.profile import Ports, SimProfile
from edoras_tools.io.net.sockets import local_endpoint, open_bound
from edoras_tools.io.outputs import write_bytes
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from edoras_tools.mission import Bridge, Route


HOST: Final = "127.0.0.1"
LAYOUTS: Final = {
    "rover": "foxglove_layout_rover",
    "arm": "foxglove_layout_arm",
    "two-rovers": "foxglove_layout",
    "two-arms": "foxglove_layout_two_arms",
}
_TO_LIMIT: Final = 20
"""Packets of one state that may wait in Telemetry Output: those of 0.5 s at 30 Hz, and a reserve."""


class Lane(msgspec.Struct, frozen=True):
    """One robot and its four topics.

    Attributes:
        robot: name.
        command: the ground route to cFS.
        state: the ground route from cFS.
        board_command: the command route at the robot; None if the robot is part of the flight application.
        board_state: the state route at the robot; None if the robot is part of the flight application.
    """

    robot: str
    command: Route
    state: Route
    board_command: Route | None = None
    board_state: Route | None = None


def free_ports() -> Ports:
    """Return free ports.

    They are not the default ports: the demo would also receive other programs' traffic on those.

    Raises:
        CaptureError: the system has no free port.
    """
    with ExitStack() as stack:
        opened = [stack.enter_context(open_bound(Endpoint(HOST, 0))) for _ in range(4)]
        return Ports(*(local_endpoint(item).port for item in opened))


def profile(ports: Ports, states: Iterable[int]) -> SimProfile:
    """Return a cFS on these ports, with the flight bridge as its peer, and TO limits for the states.

    Args:
        states: MsgIds of the states that go to the ground.
    """
    usual = SimProfile(address=HOST).on(ports)
    return replace(usual, to_limits={**usual.to_limits, **dict.fromkeys(states, _TO_LIMIT)})


def write_missions(scenario: Scenario, folder: Path, ports: Ports, max_rate: float) -> list[Path]:
    """Write a demo's mission files.

    Args:
        ports: ports that replace the default ones.
        max_rate: states per second that the flight bridge forwards for each robot; 0 for all.

    Raises:
        CaptureError: they cannot be written.
    """
    samples = files("edoras_tools.samples")
    paths = []
    for name in MISSIONS[scenario]:
        text = (samples / f"missions/{name}.yaml").read_text(encoding="utf-8")
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
        write_bytes(path, text.encode())
        paths.append(path)
    return paths


def lanes_of(scenario: Scenario, bridges: Iterable[Bridge]) -> tuple[Lane, ...]:
    """Return the robots of a demo, from its bridges."""
    bridges = list(bridges)
    ways = (("ground", True), ("ground", False), ("flight", False), ("flight", True))
    groups = [routes_of_kind(bridges, kind, to_cfs=to_cfs) for kind, to_cfs in ways]
    if not groups[-1]:
        return tuple(Lane(scenario, *pair) for pair in zip(*groups[:2], strict=True))
    rows = zip(*groups, strict=True)
    return tuple(Lane(row[0].topic.split("/")[1], *row) for row in rows)
