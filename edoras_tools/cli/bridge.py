"""``edoras bridge``: replaces the ground bridge and the flight bridge."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from msgspec.structs import replace
from typer import Argument, BadParameter, Option

from edoras_tools import doors
from edoras_tools.cli import options
from edoras_tools.cli.options import grouped, headed
from edoras_tools.cli.output import print_json, print_view, say, tell, tell_reach
from edoras_tools.cli.relays import RelayOutputOptions, finish_relay, run_relay
from edoras_tools.cli.sending import Yes, confirm_targets
from edoras_tools.middleware.graph import middleware, names
from edoras_tools.older import StrEnum
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.pipelines.bridge.run import Bridges


class BridgeKind(StrEnum):
    """Which bridges of the files to run."""

    GROUND = "ground"
    FLIGHT = "flight"


_FOXGLOVE: Final = "foxglove"


def middleware_name(text: str) -> str:
    """Read the name of a middleware."""
    choices = names()
    if text not in choices and doors.find("middleware", text) is None:
        raise BadParameter(f"{text!r} is not one of {', '.join(map(repr, choices))}.")
    return text


@headed("ROS 2")
class RosOptions(NamedTuple):
    """How to connect to the ROS 2 graph."""

    ros: Annotated[
        str | None,
        Option(
            parser=middleware_name,
            autocompletion=options.completing(names()),
            show_default=False,
            metavar=f"<{'|'.join(names())}>",
            help="Default: dds, or by RMW_IMPLEMENTATION.",
        ),
    ] = None
    domain: options.RosDomain = None
    ros_options: options.RosOption = None


@headed("ROS 2")
class NodeOptions(NamedTuple):
    """Settings of a ROS 2 node."""

    ros_args: Annotated[
        list[str] | None,
        Option(
            metavar="... --",
            help="As of a ROS node: -r __ns:=/robot_1, -r FROM:=TO, -p NAME:=VALUE, --params-file FILE.",
        ),
    ] = None


class PacketOptions(NamedTuple):
    """Settings of the packets sent to cFS, and requests to cFS."""

    max_rate: Annotated[
        list[str] | None,
        Option(
            metavar="[TOPIC=]HZ[,KEEP]",
            help="Messages per second to cFS for each topic, one topic, or all=HZ; KEEP: latest, first.",
        ),
    ] = None
    checksum: Annotated[bool, Option("--checksum", help="Send real checksums in commands, not 0.")] = False
    sequence: Annotated[bool, Option("--sequence", help="Send real sequence counts, not 0.")] = False
    enable: Annotated[bool, Option(" /--no-enable", help="Do not enable Telemetry Output.")] = True


class RunOptions(NamedTuple):
    """Settings of the run: its duration, and whether to run at all."""

    duration: options.Duration = None
    yes: Yes = False
    dry_run: Annotated[bool, Option("--dry-run", help="Print what would be bridged; open nothing.")] = False


@grouped
def bridge(
    *,
    kind: Annotated[BridgeKind | None, Argument(metavar="[KIND]", help="Only ground or flight.")] = None,
    graph: RosOptions,
    node: NodeOptions,
    packets: PacketOptions,
    outputs: RelayOutputOptions,
    running: RunOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Bridge ROS 2 and cFS with the files of EDORAS's bridges.

    No installed ROS 2 is needed.

    Every bridge of every file runs, in one process: edoras bridge -c ground.yaml -c flight.yaml
    """
    from edoras_tools.middleware.graph import distro_of_peers, usual, usual_domain
    from edoras_tools.pipelines.bridge.plan import BridgeRequest, plan_bridges
    from edoras_tools.render import bridge as view

    (json, quiet), output = printing, outputs.output
    way = graph.ros or usual()
    request = BridgeRequest(
        kind.value if kind else None,
        tuple(packets.max_rate or ()),
        checksum=packets.checksum,
        sequence=packets.sequence,
        enable=packets.enable,
    )
    settings = decoding.settings()
    if node.ros_args:
        settings = doors.part("ros_args_settings")(settings, node.ros_args)
    domain = usual_domain() if graph.domain is None else graph.domain
    ros_options = _options(way, graph.ros_options, outputs)
    if decoding.merged().distro is None and not running.dry_run:
        distro = distro_of_peers(way, domain, ros_options)
        if distro not in {None, settings.distro}:
            _say(f"the nodes of domain {domain} are of ROS 2 {distro}: --set distro={distro}")
            settings = replace(settings, distro=distro)
    plan = plan_bridges(settings, request)
    if running.dry_run:
        planned = [item.summary() for item in plan.stations]
        if json:
            print_json({"ros": way, "bridges": planned, "notes": list(plan.notes)})
        else:
            for note in plan.notes:
                _say(note)
            print_view(lambda width: view.plan(planned, way, output, width))
        return
    from edoras_tools.pipelines.bridge.run import Bridges
    from edoras_tools.render.terminal.palette import detect_terminal

    confirm_targets(*(station.target for station in plan.stations), confirmed=running.yes)

    shows = not quiet and not json and detect_terminal(sys.stderr).interactive
    names = (f"{item.kind} bridge {item.listen} to {item.target}" for item in plan.stations)
    bridges = Bridges(
        plan,
        request,
        ros=way,
        domain=domain,
        options=ros_options,
        recorder=outputs.recorder(plan.workbench, ", ".join(names), kind="bridge"),
        say=None if shows else _say,
    )
    table = partial(view.live_table, output=output) if shows else None
    failure = run_relay(bridges, partial(_begin, bridges), running.duration, table, metrics=outputs.metrics)
    for note in bridges.notes if shows else ():
        _say(note)
    finish_relay(bridges, view.outcome, view.losses, output, printing, failure)


def _options(way: str, ros_options: list[Any] | None, outputs: RelayOutputOptions) -> dict[str, str]:
    """Return the middleware's options; for Foxglove also the allowed origins and the token."""
    pairs: dict[str, str] = dict(ros_options or ())
    if way == _FOXGLOVE:
        more = {"origins": ",".join(outputs.allow_origin or ()), "token": outputs.token or ""}
        pairs |= {name: text for name, text in more.items() if text}
    return pairs


def _begin(bridges: Bridges) -> None:
    """Print which topics are bridged, and who can reach the bridges."""
    for station in bridges.stations:
        topics = plural(len(station.machine.routes), "topic")
        say(
            f"bridging {topics} through {bridges.ros}: {station.plan.name}, {station.plan.kind}, "
            f"{station.endpoint} to {station.plan.target}; Ctrl-C ends"
        )
        tell_reach(station.endpoint, "send what is published in ROS 2")
    if middleware(bridges.ros).open:
        _say(
            "the ROS 2 domain is open: every node on its network can publish messages that are bridged; "
            "--ros zenoh listens on this machine only"
        )


def _say(text: str) -> None:
    from edoras_tools.render.terminal.text import clean

    tell(clean(text))  # it may contain text that a peer sent
