"""Options that several commands share, and how their words become values."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

if TYPE_CHECKING:
    from edoras_tools.model import Link
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.faults import FaultPlan

Command = Callable[..., None]
LINKS = ("ci", "to", "sbn", "other")


def number(text: str) -> int:
    """Read a whole number, decimal or hex."""
    try:
        return int(text, 0)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no whole number; write 42 or 0x2a") from None


def counted(text: str) -> int:
    """Read a number of things: 1 or more."""
    value = number(text)
    if value < 1:
        raise typer.BadParameter(f"{text} is not 1 or more")
    return value


def msg_id(text: str) -> int:
    """Read a MsgId: 16 bits, decimal or hex."""
    value = number(text)
    if not 0 <= value <= 0xFFFF:
        raise typer.BadParameter(f"MsgId {text} does not fit 16 bits (0x0000 to 0xFFFF)")
    return value


def size(text: str) -> int:
    """Read a size in bytes: ``500000``, ``64k``, ``100M``, ``2G``."""
    units = {"k": 10**3, "m": 10**6, "g": 10**9}
    digits, unit = (text[:-1], units[text[-1].lower()]) if text[-1:].lower() in units else (text, 1)
    try:
        value = float(digits) * unit
    except ValueError:
        value = 0
    if not 1 <= value < 1 << 62:
        raise typer.BadParameter(f"{text!r} is no size; write 500000, 64k, 100M or 2G")
    return int(value)


def duration(text: str) -> int:
    """Read a length of time in ns: ``90``, ``1.5s``, ``10m``, ``2h``, ``250ms``."""
    units = {"ms": 1e6, "s": 1e9, "m": 60e9, "h": 3600e9}
    name = next((unit for unit in units if text.endswith(unit)), "")
    try:
        value = float(text.removesuffix(name)) * units.get(name, 1e9)
    except ValueError:
        value = 0
    if not 1 <= value < 1 << 62:
        raise typer.BadParameter(f"{text!r} is no length of time; write 90, 1.5s, 10m or 250ms")
    return int(value)


def link_name(text: str) -> str:
    """Read a link's name."""
    if text.lower() not in LINKS:
        raise typer.BadParameter(f"{text!r} is no link; there are {', '.join(LINKS)}")
    return text.lower()


def where(text: str) -> str:
    """Read a filter; that its names are fields is found out once the mission is known."""
    from edoras_tools.decode.where_syntax import parse

    parse(text)
    return text


def link_port(text: str) -> tuple[Link, int]:
    """Read ``LINK:PORT``, as ``ci:5010``."""
    from edoras_tools.model import Link

    name, _, port = text.partition(":")
    if name.lower() not in LINKS[:3] or not port.isdecimal() or not 0 < int(port) < 65536:
        raise typer.BadParameter(f"{text!r} is no LINK:PORT; write ci:5010, to:5011 or sbn:5012")
    return Link[name.upper()], int(port)


Config = Annotated[
    list[Path] | None,
    typer.Option("--config", "-c", metavar="FILE", help="EDORAS bridge YAML; repeat for several."),
]
Distro = Annotated[str, typer.Option(metavar="NAME", help="ROS 2 distribution whose messages hold.")]
MsgPath = Annotated[
    list[Path] | None,
    typer.Option("--msg-path", metavar="DIR", help="Folder with further .msg or .idl files; repeatable."),
]
Port = Annotated[
    list[Any] | None,  # pairs of Link and port; their type would cost the import of numpy
    typer.Option(
        "--port",
        metavar="LINK:PORT",
        parser=link_port,
        help="Further UDP port of ci, to or sbn; repeatable.",
    ),
]
Envelope = Annotated[
    str, typer.Option(metavar="FORMAT", help="EDORAS envelope: 8/8, 4/4, 1/1, with le or be; or auto.")
]
ExtendedHeader = Annotated[bool, typer.Option(help="Packets carry cFE's extended (version 2) header.")]
TelemetryHeader = Annotated[
    int, typer.Option(metavar="BYTES", help="cFE telemetry header: 16, or 12 in older builds.")
]
StructsFile = Annotated[
    list[Path] | None,
    typer.Option(
        "--structs", metavar="FILE", help="Layout of C structs, as 'edoras structs' writes it; repeatable."
    ),
]
LinkChoice = Annotated[
    list[str] | None,
    typer.Option("--link", metavar="LINK", parser=link_name, help="Only ci, to, sbn or other; repeatable."),
]
MsgIdChoice = Annotated[
    list[int] | None,
    typer.Option("--msg-id", metavar="ID", parser=msg_id, help="Only this MsgId, as 0x827; repeatable."),
]
TopicChoice = Annotated[
    list[str] | None,
    typer.Option("--topic", metavar="PATTERN", help="Only topics that fit, as '/robot_*'; repeatable."),
]
Where = Annotated[
    str | None,
    typer.Option(
        metavar="EXPR",
        parser=where,
        help="Only what a filter lets pass, as 'msg_id == 0x827 and pose.position.x > 1'.",
    ),
]
Read = Annotated[
    list[Path] | None,
    typer.Option(
        "--read", "-r", metavar="FILE", help="pcap, pcapng (.gz, .zst) or MCAP; - is stdin; repeatable."
    ),
]
Interface = Annotated[
    str | None, typer.Option("--interface", "-i", metavar="IFACE", help="Capture live from an interface.")
]
Listen = Annotated[
    list[str] | None,
    typer.Option(
        "--listen",
        metavar="[HOST:]PORT",
        help="Bind a UDP port and take what arrives: no privilege; repeatable.",
    ),
]
Count = Annotated[
    int | None, typer.Option("--count", "-n", metavar="N", parser=counted, help="Stop after N datagrams.")
]
Duration = Annotated[
    int | None,
    typer.Option("--duration", metavar="TIME", parser=duration, help="Stop after so long, as 30, 10m."),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary.")]
Verbose = Annotated[bool, typer.Option("--verbose", "-v", help="Say more on stderr.")]


def decoding(
    config: Config = None,
    distro: Distro = "humble",
    msg_path: MsgPath = None,
    port: Port = None,
    envelope: Envelope = "8/8 le",
    extended_header: ExtendedHeader = False,
    telemetry_header: TelemetryHeader = 16,
    structs: StructsFile = None,
) -> Settings:
    """Gather the options of missions, types and decoding."""
    from edoras_tools.decode import Options
    from edoras_tools.pipelines.workbench import Settings

    options = Options(
        extended_header=extended_header,
        telemetry_header=telemetry_header,
        envelope=envelope,
        ports=tuple(port or ()),
    )
    return Settings(tuple(config or ()), distro, tuple(msg_path or ()), options, tuple(structs or ()))


def choice(
    link: LinkChoice = None, msg_id: MsgIdChoice = None, topic: TopicChoice = None, where: Where = None
) -> Selection:
    """Gather the options that choose datagrams."""
    from edoras_tools.model import Link
    from edoras_tools.pipelines.selection import Selection

    return Selection(
        tuple(Link[item.upper()] for item in link or ()),
        tuple(msg_id or ()),
        tuple(topic or ()),
        where=where or "",
    )


def gathered(name: str, gather: Callable[..., object]) -> Callable[[Command], Command]:
    """Let a command take a group of options as one value.

    Args:
        name: the command's parameter that receives the value.
        gather: a function whose parameters are the options, and whose result is the value.
    """

    def decorate(command: Command) -> Command:
        grouped = [item.name for item in _parameters(gather)]
        parameters = [item for item in _parameters(command) if item.name != name] + _parameters(gather)

        @wraps(command)
        def call(**given: object) -> None:
            command(**{name: gather(**{option: given.pop(option) for option in grouped}), **given})

        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {item.name: item.annotation for item in parameters}
        return call

    return decorate


def _parameters(function: Callable[..., object]) -> list[inspect.Parameter]:
    """Return a function's parameters, by keyword, their annotations as values: as typer wants them."""
    unimported = dict.fromkeys(("Settings", "Selection", "Orders", "FaultPlan"), object)
    hints = get_type_hints(function, localns=unimported, include_extras=True)
    return [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[item.name])
        for item in inspect.signature(function).parameters.values()
    ]


takes_decoding = gathered("settings", decoding)
takes_choice = gathered("selection", choice)


FaultRule = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="RULE",
        help="What goes wrong: drop:0.1, delay:200ms,msg_id=0x1827, corrupt:1%,from=10s; repeatable.",
    ),
]
Profile = Annotated[
    str | None, typer.Option(metavar="NAME", help="Behave as a link of this kind: leo, geo, lunar or mars.")
]
Scenario = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Faults and their times from a YAML file.")
]
Seed = Annotated[
    int | None,
    typer.Option(metavar="N", parser=number, help="Chances hang on it: the same seed, the same faults; 0."),
]


def faults(
    fault: FaultRule = None, profile: Profile = None, scenario: Scenario = None, seed: Seed = None
) -> FaultPlan:
    """Gather the options that say what goes wrong on purpose."""
    from edoras_tools.pipelines.scenario import fault_plan

    return fault_plan(fault or (), profile, scenario, seed)


takes_faults = gathered("faults", faults)
