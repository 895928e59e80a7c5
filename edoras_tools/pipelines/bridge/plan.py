"""Mission files to bridges that can run: errors of one bridge are reported, and the others run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal

import msgspec
from msgspec.structs import replace

from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.errors import ConfigError, RouteError
from edoras_tools.io.net.sockets import arrives_at
from edoras_tools.middleware import Qos
from edoras_tools.mission import Bridge, GroundLink, Route, load, read_scalar
from edoras_tools.mission.bridges import node_of
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings, Workbench
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.bridge import describe

BridgeKind = Literal["ground", "flight"]
_DEPTH: Final = 10


class BridgeRequest(msgspec.Struct, frozen=True):
    """Settings from the command line for all bridges.

    Attributes:
        kind: only bridges of this kind; None for all.
        limits: rate limits as text: ``30``, ``/cmd_vel=30,first``, ``all=100``.
        checksum: send real checksums in commands.
        sequence: send real sequence counts.
        enable: ask Telemetry Output to send.
    """

    kind: BridgeKind | None = None
    limits: Sequence[str] = ()
    checksum: bool = False
    sequence: bool = False
    enable: bool = True


class StationPlan(msgspec.Struct, frozen=True):
    """One bridge to run.

    Attributes:
        name: name of its node, unique; it may have a namespace in front.
        bridge: link and routes, without routes that cannot be bridged.
    """

    name: str
    bridge: Bridge

    @property
    def kind(self) -> BridgeKind:
        """``ground`` or ``flight``."""
        return "ground" if isinstance(self.bridge.link, GroundLink) else "flight"

    @property
    def node(self) -> str:
        """The node's name as the middleware expects it."""
        return f"/{self.name}" if "/" in self.name else self.name

    @property
    def listen(self) -> Endpoint:
        """The address that cFS sends to."""
        link = self.bridge.link
        if isinstance(link, GroundLink):
            return Endpoint(link.telemetry_ip, link.bridge_port)
        return link.bridge

    @property
    def target(self) -> Endpoint:
        """The address where cFS listens."""
        link = self.bridge.link
        return link.command_ingest if isinstance(link, GroundLink) else link.peer

    def summary(self) -> dict[str, Any]:
        """Return this bridge's part of ``bridge --json``."""
        return {
            "name": self.name,
            "kind": self.kind,
            "file": self.bridge.link.file,
            "listen": str(self.listen),
            "target": str(self.target),
            "routes": [describe(route) for route in self.bridge.routes],
        }


class BridgePlan(msgspec.Struct, frozen=True):
    """The bridges to run.

    Attributes:
        stations: the bridges, at least one.
        types: the ROS types.
        settings: settings of the command line.
        notes: errors and doubtful settings, one line each.
    """

    stations: tuple[StationPlan, ...]
    types: TypeStore
    settings: Settings
    notes: tuple[str, ...] = ()

    def workbench(self) -> Workbench:
        """Return the workbench for a recording of all bridges.

        Raises:
            ConfigError: two bridges use one MsgId on one kind of link; a recording cannot distinguish them.
        """
        wishes = self.settings
        mission = load(wishes.configs, msg_ids=wishes.options.msg_ids, ros_args=wishes.ros_args)
        routes = tuple(route for route in mission.routes if self.types.has(route.type))
        context = Context(replace(mission, routes=routes), self.types, self.settings.options)
        return Workbench(context.mission, self.types, ColumnDecoder(context))


def qos_of(route: Route) -> Qos:
    """Return the quality of service of a topic.

    A policy that the file leaves out: for a topic to cFS, whatever each publisher offers; for a topic from
    cFS, reliable and transient local, as in the public bridges. The depth is 10 instead of their 1.
    """
    wish, usual = route.handling, None if route.to_cfs else True
    return Qos(
        reliable=usual if wish.reliable is None else wish.reliable,
        transient_local=usual if wish.transient_local is None else wish.transient_local,
        depth=wish.depth or _DEPTH,
    )


def plan_bridges(settings: Settings, request: BridgeRequest) -> BridgePlan:
    """Read the mission files, each on its own: two cFS may use the same MsgIds.

    Raises:
        ConfigError: a file has errors, nothing is left to bridge, or a bridge would send to itself.
        RouteError: a rate limit names a topic that is not bridged.
    """
    if not settings.configs:
        raise ConfigError("a bridge needs a mission file of the public bridges: -c FILE")
    types = TypeStore(settings.distro, settings.msg_paths)
    mistakes: list[str] = []
    notes: list[str] = []
    bridges: list[Bridge] = []
    for path in dict.fromkeys(settings.configs):
        try:
            mission = load(path, msg_ids=settings.options.msg_ids, ros_args=settings.ros_args)
        except ConfigError as error:
            mistakes += error.mistakes
            continue
        notes += mission.warnings
        bridges += mission.bridges
    if mistakes:
        raise ConfigError(*mistakes)
    selection = [item for item in bridges if request.kind in {None, _kind(item)}]
    if not selection:
        raise ConfigError(
            f"no {request.kind} bridge in {', '.join(map(str, settings.configs))}; "
            f"name the other kind, or its file with -c"
        )
    selection = _limited(selection, request.limits)
    judge = _Judge(types, notes)
    stations = [
        StationPlan(name, replace(bridge, routes=tuple(filter(judge.takes(bridge), bridge.routes))))
        for name, bridge in zip(_names(selection), selection, strict=True)
    ]
    usable = tuple(item for item in stations if item.bridge.routes)
    if not usable:
        raise ConfigError(*(judge.refusals or ["nothing to bridge: command and telemetry are empty"]))
    circles = [
        f"{item.bridge.link.file}: the bridge listens on {item.listen} and sends to {item.target}, which is "
        f"itself; change one of the two ports"
        for item in usable
        if arrives_at(item.target, item.listen)
    ]
    if circles:
        raise ConfigError(*circles)
    return BridgePlan(usable, types, settings, tuple(notes))


def _kind(bridge: Bridge) -> BridgeKind:
    return "ground" if isinstance(bridge.link, GroundLink) else "flight"


def _names(bridges: Sequence[Bridge]) -> list[str]:
    """Return a unique node name for each bridge."""
    names: list[str] = []
    for bridge in bridges:
        namespace, last = node_of(bridge.name)  # a wildcard cannot be the name of a node
        name = f"{namespace}/{last or _kind(bridge) + '_bridge'}".removeprefix("/")
        number, free = 2, name
        while free in names:
            free, number = f"{name}_{number}", number + 1
        names.append(free)
    return names


class _Judge:
    """Decides which routes can be bridged, and why the others cannot.

    Attributes:
        refusals: reasons for leaving routes out, one line each.
    """

    def __init__(self, types: TypeStore, notes: list[str]) -> None:
        self.refusals: list[str] = []
        self._types, self._notes = types, notes
        self._topics: dict[str, Route] = {}
        self._claims: dict[tuple[object, ...], Route] = {}

    def takes(self, bridge: Bridge) -> Callable[[Route], bool]:
        """Return a function that decides whether a route of a bridge can be bridged."""
        station = StationPlan("", bridge)

        def take(route: Route) -> bool:
            why = self._wrong(route, station)
            if why is not None:
                self.refusals.append(
                    f"{route.file}:{route.line}: {route.key}: {why}; {route.topic} is left out"
                )
                self._notes.append(self.refusals[-1])
            return why is None

        return take

    def _wrong(self, route: Route, station: StationPlan) -> str | None:
        unknown = self._types.check(route.type)
        if unknown is not None:
            return unknown
        other = self._topics.setdefault(route.topic, route)
        if other.type != route.type:
            return f"the topic is {route.type} here and {other.type} in {other.file}:{other.line}"
        other = self._claims.setdefault((route.link, station.target, route.msg_id), route)
        if (other.topic, other.type) != (route.topic, route.type):
            return f"0x{route.msg_id:04X} of the same cFS is {other.topic} in {other.file}:{other.line}"
        return None


def _limited(bridges: list[Bridge], limits: Sequence[str]) -> list[Bridge]:
    """Replace the rate limits of the files by those of the command line."""
    for text in limits:
        name, equals, rest = text.rpartition("=")
        rate, comma, keep = rest.partition(",")
        hertz = read_scalar(rate)
        usable = isinstance(hertz, int | float) and not isinstance(hertz, bool) and 0 < hertz < float("inf")
        if (
            not usable
            or (comma and (keep not in {"latest", "first"} or name == "all"))
            or (equals and not name)
        ):
            raise ConfigError(f"--max-rate {text}: write 30, /cmd_vel=30,first or all=100")
        if name == "all":
            bridges = [replace(item, max_rate_total=float(hertz)) for item in bridges]
            continue
        wish: dict[str, Any] = {"max_rate": float(hertz), **({"keep": keep} if keep else {})}
        count = 0
        changed = []
        for bridge in bridges:
            rows = [_called(route, name) if name else route.to_cfs for route in bridge.routes]
            count += sum(rows)
            routes = (
                replace(route, handling=replace(route.handling, **wish)) if limited else route
                for route, limited in zip(bridge.routes, rows, strict=True)
            )
            changed.append(replace(bridge, routes=tuple(routes)))
        if not count:
            topics = ", ".join(route.topic for bridge in bridges for route in bridge.routes)
            raise RouteError(f"--max-rate {text}: {name or 'no topic'} is not bridged; there are {topics}")
        bridges = changed
    return bridges


def _called(route: Route, name: str) -> bool:
    number = read_scalar(name)
    if isinstance(number, int) and not isinstance(number, bool):
        return route.msg_id == number
    return name in {route.topic, route.topic.removeprefix("/"), route.key}


def sizes_of(types: TypeStore, routes: Sequence[Route]) -> Mapping[str, int | None]:
    """Return the size in bytes of the types that have a fixed size; None for the others."""
    return {route.type: types.fixed_size(route.type) for route in routes}
