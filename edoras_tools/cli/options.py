"""Options that several commands share, and the parsers of their values.

Commands are functions whose parameters are declared as Typer requires, with
``Annotated[..., typer.Option(...)]``. Typer has no groups; this file adds them:

1. Options that belong together are the fields of a ``NamedTuple``, with their declarations and defaults.
   ``grouped`` lets a command take such a group as one value. A method of the group returns the value that
   pipelines take.
2. ``headed`` gives a group its own heading in help texts, Typer's ``rich_help_panel``.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from functools import cache, partial, wraps
from pathlib import Path
from time import strftime
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, TypeVar, get_args, get_type_hints

from typer import BadParameter, Context, Option

from edoras_tools import doors
from edoras_tools.errors import ConfigError
from edoras_tools.links import ROWS
from edoras_tools.middleware import MOST_DOMAIN
from edoras_tools.older import UTC, StrEnum

if TYPE_CHECKING:
    from datetime import tzinfo

    from edoras_tools.model import Link
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.reading import Limits
    from edoras_tools.pipelines.selection import ClockTime, Period, Selection
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.faults.machine import FaultPlan

_Group = TypeVar("_Group", bound=type)


def headed(text: str) -> Callable[[_Group], _Group]:
    """Give a group of options its own heading in help texts; groups inside it get the same heading."""

    def mark(group: _Group) -> _Group:
        group.heading = text  # type: ignore[attr-defined]
        return group

    return mark


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Let a command take options in groups: a parameter whose type is a ``NamedTuple`` stands for its fields.

    Typer sees an option for each field, in place of the parameter, with the field's name, type and default. A
    field may itself be a group.
    """
    options = list(_options(command))

    @wraps(command)
    def call(**values: Any) -> None:
        _filled(command, values)

    call.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    call.__annotations__ = {item.name: item.annotation for item in options}
    return call


def _options(holder: Callable[..., Any], heading: str = "") -> Iterator[inspect.Parameter]:
    """Yield the options of a command or a group; nested groups are replaced by their options."""
    heading = getattr(holder, "heading", heading)
    for item in parameters(holder):
        if _is_group(item.annotation):
            yield from _options(item.annotation, heading)
        elif heading:
            kind, declared = get_args(item.annotation)
            declared = copy(declared)
            declared.rich_help_panel = heading
            yield item.replace(annotation=Annotated[kind, declared])
        else:
            yield item


def _filled(holder: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    """Call a command, or make a group, with the values of its options."""
    return holder(
        **{
            item.name: _filled(item.annotation, values) if _is_group(item.annotation) else values[item.name]
            for item in parameters(holder)
        }
    )


@cache
def parameters(holder: Callable[..., Any]) -> list[inspect.Parameter]:
    """Return keyword parameters with evaluated annotations, as Typer needs them."""
    hints = get_type_hints(holder, include_extras=True)
    if sys.version_info < (3, 11):  # there a default of None changes ``X`` to ``X | None``
        hints = {
            name: next((item for item in get_args(hint) if hasattr(item, "__metadata__")), hint)
            for name, hint in hints.items()
        }
    return [
        item.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[item.name])
        for item in inspect.signature(holder).parameters.values()
    ]


def _is_group(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, tuple)


LINKS = (*ROWS, *doors.shipped("links"), "other")


def number(text: str) -> int:
    """Read a whole number, decimal or hex."""
    try:
        return int(text, 0)
    except ValueError:
        raise BadParameter(f"{text!r} is not a whole number; write 42 or 0x2a") from None


def count(text: str) -> int:
    """Read a count: 1 or more."""
    value = number(text)
    if value < 1:
        raise BadParameter(f"{text} is less than 1")
    return value


def packets(text: str) -> int | str:
    """Read a MsgId, or a name that tables show, which is looked up when the mission is known."""
    return msg_id(text) if text[:1].isdecimal() or text[:1] in "-+" else text


def msg_id(text: str) -> int:
    """Read a MsgId: 16 bits, decimal or hex, or its name, e.g. ``TO_CMD``."""
    if text[:1].isalpha():
        return _named_msg_id(text)
    if re.fullmatch(r"[01][89]\d\d", text):  # as cFS's MsgIds look in hex
        raise BadParameter(f"{text} is decimal, 0x{int(text):04x}; did you mean 0x{text}?")
    value = number(text)
    if not 0 <= value <= 0xFFFF:
        raise BadParameter(f"MsgId {text} does not fit 16 bits (0x0000 to 0xFFFF)")
    return value


def _named_msg_id(text: str) -> int:
    from edoras_tools.cfs.names import MSG_ID_NAMES
    from edoras_tools.words import did_you_mean

    ids = {name: value for value, name in MSG_ID_NAMES.items()}
    name = text.upper()
    if name not in ids:
        hint = did_you_mean(name, ids, 1) or "write 0x827, or a name, e.g. TO_CMD"
        raise BadParameter(f"no MsgId is named {text!r}; {hint}")
    return ids[name]


def size(text: str) -> int:
    """Read a size in bytes: ``500000``, ``64k``, ``100M``, ``2G``; ``100MB`` and ``4 KiB`` too; 0 is none."""
    if text == "0":
        return 0
    match = re.fullmatch(r"([\d.]+) ?([kMGT]?)(i?)B?", text, re.IGNORECASE)
    try:
        digits, prefix, binary = match.groups() if match else ("", "", "")
        value = float(digits) * (1024 if binary else 1000) ** ["", *"kmgt"].index(prefix.lower())
    except ValueError:
        value = 0
    if not 1 <= value < 1 << 62:
        raise BadParameter(f"{text!r} is not a size; write 500000, 64k, 100M or 2G")
    return int(value)


def duration(text: str) -> int:
    """Read a duration in ns: ``90``, ``1.5s``, ``10m``, ``5min``, ``2h``, ``250ms``; 0 is none."""
    if text in {"0", "0s"}:
        return 0
    units = {"ms": 1e6, "s": 1e9, "min": 60e9, "m": 60e9, "h": 3600e9}
    name = next((unit for unit in units if text.endswith(unit)), "")
    try:
        value = float(text.removesuffix(name)) * units.get(name, 1e9)
    except ValueError:
        value = 0
    if not 1 <= value < 1 << 62:
        raise BadParameter(f"{text!r} is not a duration; write 90, 1.5s, 10m or 250ms")
    return int(value)


_CLOCK = (
    r"(?:(\d{4}-\d\d-\d\d)(?:[T ]|$))?(?:(\d\d?):(\d\d)(?::(\d\d)(\.\d{1,9})?)?)?"
    r"( ?[A-Za-z][\w/+-]*|[+-]\d\d:?\d\d)?"
)
"""Groups: date, hour, minute, second, fraction, zone."""


def recording_path(text: str) -> Path:
    """Read the path of a recording; ``%Y``, ``%H%M%S`` etc. are replaced by the local time (``strftime``)."""
    return Path(strftime(text) if "%" in text else text)


def amount(text: str) -> tuple[str, int]:
    """Read a number, a time as ``10m`` or a size as ``500M``; return its kind too."""
    if text.isdecimal():
        return "count", count(text)
    for kind, read in (("time", duration), ("size", size)):
        with suppress(BadParameter):
            return kind, read(text)
    raise BadParameter(f"{text!r} is no number, no time as 10m, and no size as 500M")


def moment(text: str) -> tuple[str, int]:
    """Read a time: a duration after the capture's start, or a clock time, e.g. 12:03:05.5, also with a date.

    Returns:
        The text of a clock time, which ``at`` reads when its zone is known, else an empty one; and ns.
    """
    text = text.strip()
    match = re.fullmatch(_CLOCK, text)
    if match and any(match.groups()[:2]) and not text.isdecimal():
        at(text, UTC)
        return text, 0
    try:
        return "", duration(text)
    except BadParameter:
        raise BadParameter(
            f"{text!r} is not a time; write 90, 1.5s or 10m after the capture's start, 12:03:05.5, or "
            "2026-07-23T12:03"
        ) from None


def at(text: str, zone: tzinfo | None) -> ClockTime:
    """Read a clock time, with or without a date.

    Args:
        text: as ``moment`` accepted it.
        zone: zone for a text without one; None for this machine's.
    """
    from datetime import date, time, timedelta, timezone

    from edoras_tools.pipelines.selection import ClockTime

    match = re.fullmatch(_CLOCK, text)
    assert match, "moment() accepted it"
    day, hour, minute, second, fraction, own = match.groups()
    clock = [int(item or 0) for item in (hour, minute, second)]
    try:
        time(clock[0], clock[1], clock[2])
        date_ = date.fromisoformat(day) if day else None
        if own and own[0] not in "+-":
            (zone,) = time_zone(own.strip())
        elif own:
            minutes = int(own[1:3]) * 60 + int(own[-2:])
            zone = timezone(timedelta(minutes=-minutes if own[0] == "-" else minutes))
    except ValueError:
        raise BadParameter(f"{text!r} is not a time of the clock or a date") from None
    seconds = (clock[0] * 60 + clock[1]) * 60 + clock[2]
    return ClockTime(text, seconds * 10**9 + int((fraction or ".")[1:].ljust(9, "0")), date_, zone)


def time_zone(text: str) -> tuple[tzinfo | None]:
    """Read the name of a time zone; return it in a tuple, with None for ``local``, this machine's zone."""
    if text.lower() == "local":
        return (None,)
    if text.upper() in {"UTC", "Z"}:
        return (UTC,)
    import zoneinfo

    try:
        return (zoneinfo.ZoneInfo(text),)
    except (zoneinfo.ZoneInfoNotFoundError, ValueError, OSError):
        from edoras_tools.words import did_you_mean

        zones = zoneinfo.available_timezones()
        hint = did_you_mean(text, zones, 1) if zones else "this machine knows none: pip install tzdata"
        raise BadParameter(
            f"no time zone is named {text!r}; {hint or 'write UTC, local, or e.g. Europe/Berlin'}"
        ) from None


def share(text: str) -> float:
    """Read a share: ``1%`` or ``0.01``. A bare ``1`` may mean either 1 % or all, so it is neither."""
    from edoras_tools.sessions.faults.rules import probability

    with suppress(ValueError):
        if (value := probability(text)) < 1 or "%" in text:
            return value
    raise BadParameter(f"{text!r} is not a share; write 1% or 0.01")


def room(text: str) -> tuple[str, float]:
    """Read a percentage, or ``FIELD=VALUE``."""
    name, _, number = text.rpartition("=")
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise BadParameter(f"{text!r} is neither a percentage nor FIELD=VALUE; write 10, or linear.x=0.1")
    return name, value


def link(text: str) -> Link:
    """Read a link's name."""
    from edoras_tools.links.table import link_of_label

    try:
        return link_of_label(text)
    except ConfigError as error:
        raise BadParameter(str(error)) from None


def where(text: str) -> str:
    """Read a filter; its field names are checked when the mission is known."""
    from edoras_tools.decode.filters.syntax import parse_filter

    parse_filter(text)
    return text


def link_port(text: str) -> tuple[Link, int]:
    """Read ``LINK:PORT``, as ``ci:5010``; port 0 for ``LINK:any``, for links with magic bytes as ``rtps``."""
    name, _, port = text.partition(":")
    if port == "any" and len(getattr(link(name), "magic", b"")) == 4:  # the kernel's filter compares as many
        return link(name), 0
    if not port.isdecimal() or not 0 < int(port) < 65536 or name == "other":
        raise BadParameter(f"{text!r} is not LINK:PORT; write ci:5010, to:5011 or sbn:5012")
    return link(name), int(port)


def name_value(text: str) -> tuple[str, str]:
    """Read ``NAME=VALUE``."""
    name, equals, value = text.partition("=")
    if not name or not equals:
        raise BadParameter(f"{text!r} is not NAME=VALUE")
    return name, value


def completing(names: Iterable[str]) -> Callable[[str], list[str]]:
    """Return a function that completes a word from names."""
    return lambda incomplete: [name for name in names if name.startswith(incomplete)]


def _named_messages(incomplete: str) -> list[str]:
    from edoras_tools.cfs.names import MSG_ID_NAMES

    return sorted(name for name in MSG_ID_NAMES.values() if name.startswith(incomplete))


def _named_topics(ctx: Context, incomplete: str) -> list[str]:
    """Return the topics of the missions on the command line, or in ``edoras.toml``."""
    from edoras_tools.cli.settings import in_effect
    from edoras_tools.mission import load

    try:
        file = in_effect()
        paths = ctx.params.get("config") or (
            file.defaults("", {"config": True}).get("config") if file else ()
        )
        return [item.topic for item in load(paths or ()).routes if item.topic.startswith(incomplete)]
    except ConfigError:  # a shell that completes a line has no place for it
        return []


Config = Annotated[list[Path] | None, Option("--config", "-c", help="EDORAS bridge YAML, or its folder.")]
Duration = Annotated[int | None, Option(parser=duration, help="Stop after this time, e.g. 30 or 10m.")]
Unproved = Annotated[bool, Option("--unproved", help="Also keep messages that no checksum covers.")]
Jobs = Annotated[int | None, Option(parser=count, help="Processes to use; default: free cores, up to 3.")]
EveryPort = Annotated[bool, Option("--all", "-a", help="Live: also UDP that belongs to no link.")]
RosDomain = Annotated[int | None, Option(min=0, max=MOST_DOMAIN, hidden=True)]
"""Usually ROS_DOMAIN_ID sets it, as in ROS."""
RosOption = Annotated[
    list[Any] | None, Option("--ros-option", parser=name_value, metavar="NAME=VALUE", help="Option of --ros.")
]
Json = Annotated[bool, Option("--json", help="Print JSON.")]
QUIET: Final = "No progress, no summary."
Quiet = Annotated[bool, Option("--quiet", "-q", help=QUIET, hidden=True)]
VERBOSE: Final = "Also print versions, settings file and missions, on stderr."
Verbose = Annotated[bool, Option("--verbose", "-v", help=f"{VERBOSE} Also list harmless notes.")]


_hidden: Final = partial(Option, hidden=True)
SET: Final = "How packets are decoded, or a constant of your cFS: edoras help decoding."
OLD_NAMES: Final[Mapping[str, str]] = {
    "--again": "--force",
    "--hz": "--rate",
    "--limit": "--max-rate",
    "--since": "--start",
    "--until": "--end",
    "--over": "--max-loss",
    "--command-mid": "--generator",
    "--sequence": "--diagram",
    "--seconds": "--duration",
    "--step": "--paused",
    "--allow-publish": "--allow",
    "--idle": "--timeout",
    "--host": "--bind",
    "--wait": "--no-wait",
    "--enable": "--no-enable",
    "--bridges": "--no-bridges",
}
"""Old names of options to their present names; an old negative switch to the positive one."""


SCENARIOS: Final = "A demo of the EDORAS paper: rover, arm, two-rovers or two-arms."


class Scenario(StrEnum):
    """A demo of the EDORAS paper."""

    ROVER = "rover"
    ARM = "arm"
    TWO_ROVERS = "two-rovers"
    TWO_ARMS = "two-arms"


DISTRO: Final = "jazzy"
"""``ros.store.USUAL_DISTRO``, said again: importing that would import numpy."""


def switch(text: str) -> bool:
    """Read ``yes`` or ``no``."""
    if text.lower() not in {"yes", "true", "on", "1", "no", "false", "off", "0"}:
        raise BadParameter(f"{text!r} is neither yes nor no")
    return text.lower() in {"yes", "true", "on", "1"}


SETTINGS: Final[Mapping[str, Callable[[str], Any]]] = {
    "distro": str,
    "msg_path": Path,
    "structs": Path,
    "port": link_port,
    "envelope": str,
    "extended_header": switch,
    "telemetry_header": number,
    "msg_id_version": number,
}
"""Decoding settings for ``--set`` and ``edoras.toml``, with the parsers of their values."""


def _named_settings(incomplete: str) -> list[str]:
    names = (name.replace("_", "-") for name in SETTINGS)
    return [f"{name}=" for name in names if name.startswith(incomplete)]


@headed("Decoding")
class DecodingOptions(NamedTuple):
    """Missions, types, and settings of decoding.

    Each of ``SETTINGS`` is also an option, as before ``--set`` existed.
    """

    config: Config = None
    set_values: Annotated[
        list[Any] | None,
        Option("--set", parser=name_value, metavar="NAME=VALUE", autocompletion=_named_settings, help=SET),
    ] = None
    distro: Annotated[str | None, _hidden(envvar="ROS_DISTRO", help=f"ROS 2's; default {DISTRO}.")] = None
    msg_path: Annotated[list[Path] | None, _hidden(help="Folder of your .msg or .idl files.")] = None
    structs: Annotated[list[Path] | None, _hidden(help="File of C structs, F Prime dictionary.")] = None
    port: Annotated[list[Any] | None, _hidden(parser=link_port, help="Of a link: ci:5010, rtps:any.")] = None
    envelope: Annotated[str | None, _hidden(help="Bytes of its lengths: 8/8, 4/4 le, 1/1 be, auto.")] = None
    extended_header: Annotated[
        bool | None, _hidden("--extended-header/--no-extended-header", help="Whether cFE has it: yes or no.")
    ] = None
    telemetry_header: Annotated[int | None, _hidden(help="Its bytes: 16, or 12 in older cFE.")] = None
    msg_id_version: Annotated[int | None, _hidden(help="Of cFE: 1, or 2 with extended headers.")] = None

    @property
    def constants(self) -> list[str]:
        """Constants of cFS from ``--set``, ``NAME=VALUE`` each."""
        return [
            f"{name}={text}" for name, text in self.set_values or () if name.replace("-", "_") not in SETTINGS
        ]

    def merged(self) -> DecodingOptions:
        """Return these options with the settings from ``--set``."""
        changes: dict[str, Any] = {}
        for option, text in self.set_values or ():
            name = option.replace("-", "_")
            if name in SETTINGS:
                value = SETTINGS[name](text)
                many = name in {"msg_path", "structs", "port"}
                changes[name] = [*changes.get(name, getattr(self, name) or ()), value] if many else value
        return self._replace(**changes)

    def settings(self, *, constants: bool = False) -> Settings:
        """Return these options in the form that pipelines take.

        Args:
            constants: the command uses constants of cFS too.

        Raises:
            ConfigError: ``--set`` names nothing that there is, or that has an effect.
            typer.BadParameter: its value cannot be read.
        """
        from edoras_tools.decode import Options
        from edoras_tools.pipelines.workbench import Settings, read_constants

        if not constants:
            _refuse_constants(self.constants)
        stated: dict[str, Any] = {}
        if constants and self.constants:
            stated = read_constants(self.constants)
        now = self.merged()
        options = Options(
            extended_header=now.extended_header,
            telemetry_header=now.telemetry_header,
            msg_id_version=now.msg_id_version,
            envelope=now.envelope,
            ports=tuple(now.port or ()),
        )
        return Settings(
            tuple(now.config or ()),
            now.distro or DISTRO,
            tuple(now.msg_path or ()),
            options,
            tuple(now.structs or ()),
            stated,
        )


def _refuse_constants(constants: Sequence[str]) -> None:
    """Refuse constants on the command line of a command that uses none; a settings file may have them."""
    from edoras_tools.cli.settings import in_effect
    from edoras_tools.words import did_you_mean

    file = in_effect() if constants else None
    allowed = file.values.get("set", ()) if file else ()
    for text in constants:
        if text not in allowed:
            name = text.partition("=")[0]
            hint = did_you_mean(name, [item.replace("_", "-") for item in SETTINGS], 1)
            raise ConfigError(
                f"--set {text}: {name} says nothing of how packets are decoded; "
                f"{hint or 'constants of cFS are for doctor, report, trace, hz, check and sim'}"
            )


@headed("Selection")
class SelectionOptions(NamedTuple):
    """Which datagrams to select."""

    link: Annotated[
        list[Any] | None,
        Option(parser=link, autocompletion=completing(LINKS), help=f"Only {', '.join(LINKS)}."),
    ] = None
    msg_id: Annotated[
        list[Any] | None,
        Option(parser=packets, autocompletion=_named_messages, metavar="ID", help="Only e.g. 0x827, TO_CMD."),
    ] = None
    topic: Annotated[
        list[str] | None,
        Option(autocompletion=_named_topics, help="Only topics or names that match, e.g. '/robot_*'."),
    ] = None
    where: Annotated[
        str | None,
        Option(parser=where, help="Only what passes, e.g. 'msg_id == 0x827 and pose.position.x > 1'."),
    ] = None

    def selection(self) -> Selection:
        """Return these options in the form that pipelines take."""
        from edoras_tools.pipelines.selection import Selection

        return Selection(
            tuple(self.link or ()), tuple(self.msg_id or ()), tuple(self.topic or ()), where=self.where or ""
        )


def check_duration(duration_ns: int | None, files: Sequence[Path]) -> None:
    """Refuse to read files for a duration: the amount read would depend on the machine.

    Raises:
        ConfigError: a duration and files are given.
    """
    if duration_ns and files and "-" not in map(str, files):
        raise ConfigError("--duration ends live traffic; of a file, --end selects a part")


@headed("Selection")
class TimeOptions(NamedTuple):
    """Which time of the input is used."""

    start: Annotated[
        Any,
        Option(parser=moment, metavar="TIME", help="From 10m, 12:03, 12:03 local or 2026-07-23T12:03 on."),
    ] = None
    end: Annotated[Any, Option(parser=moment, metavar="TIME", help="Leave out what comes later.")] = None
    tz: Annotated[Any, Option(parser=time_zone, hidden=True)] = None

    def period(self) -> Period:
        """Return these options in the form that pipelines take.

        Raises:
            ConfigError: the end is not after the start, or a zone is given without a clock time.
        """
        from edoras_tools.pipelines.selection import Period

        start, end = self.start or ("", 0), self.end or ("", 0)
        if self.tz and not (start[0] or end[0]):
            raise ConfigError(
                "--tz is the zone of clock times: it has no effect without, e.g., --start 12:03"
            )
        usual = self.tz[0] if self.tz else UTC
        first, last = (at(text, usual) if text else None for text, _ in (start, end))
        if self.end == ("", 0):
            raise ConfigError("--end 0 is the capture's start: nothing is left")
        return Period(start[1], end[1], first, last)


class ScopeOptions(NamedTuple):
    """The part of a capture that is examined and shown."""

    filters: SelectionOptions
    times: TimeOptions = TimeOptions()

    def scope(self) -> Scope:
        """Return these options in the form that pipelines take.

        Raises:
            ConfigError: the end is not after the start.
        """
        from edoras_tools.pipelines.doctor import Scope

        return Scope(self.filters.selection(), self.times.period())


@headed("Selection")
class PartOptions(NamedTuple):
    """Which part of the input is read."""

    datagrams: Annotated[int | None, Option("--count", "-n", parser=count, help="Stop after so many.")] = None
    duration: Duration = None
    times: TimeOptions = TimeOptions()

    def limits(self, files: Sequence[Path] = ()) -> Limits:
        """Return these options in the form that pipelines take.

        Args:
            files: files to read; none for a live source.

        Raises:
            ConfigError: the end is not after the start, or files are to be read for a duration.
        """
        from edoras_tools.pipelines.reading import Limits

        check_duration(self.duration, files)
        return Limits(self.datagrams or 0, self.duration or 0, period=self.times.period())


@headed("Printing")
class PrintOptions(NamedTuple):
    """Settings of the report."""

    json: Json = False
    quiet: Quiet = False


@headed("Faults")
class FaultOptions(NamedTuple):
    """Faults that are injected on purpose."""

    fault: Annotated[list[str] | None, Option(help="drop:0.1, delay:200ms,msg_id=0x1827, leo, x.yaml")] = None
    profile: Annotated[str | None, Option(hidden=True)] = None
    scenario: Annotated[Path | None, Option(hidden=True)] = None
    seed: Annotated[int | None, Option(parser=number, help="Seed of the random faults; default 0.")] = None

    def plan(self) -> FaultPlan:
        """Return these options in the form that pipelines take."""
        if not self.fault and not self.profile and self.scenario is None:
            from edoras_tools.sessions.faults.machine import FaultPlan

            return FaultPlan(seed=self.seed or 0)
        from edoras_tools.pipelines.faults import fault_plan

        return fault_plan(self.fault or (), self.profile, self.scenario, self.seed)
