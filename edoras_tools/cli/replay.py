"""``edoras replay``: sends a recording again."""

from __future__ import annotations

from contextlib import closing
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Argument, BadParameter, Option

from edoras_tools.cli import options, sending
from edoras_tools.cli.options import grouped, headed
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import READ

if TYPE_CHECKING:
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.sending.options import SendOptions
    from edoras_tools.pipelines.sending.replay import ReplaySelection
    from edoras_tools.pipelines.workbench import Workbench


def pair(text: str) -> tuple[str, str]:
    """Read ``A:=B``."""
    old, sign, new = text.partition(":=")
    if not (old and sign and new):
        raise BadParameter(f"{text!r} is not A:=B; write 0x1827:=0x1828 or /cmd_vel:=/robot_1/cmd_vel")
    return old, new


def speed(text: str) -> float:
    """Read a speed: times the recorded one, or ``max``, which is infinite."""
    return inf if text == "max" else sending.factor(text)


class SourceOptions(NamedTuple):
    """The input and the receiver."""

    file: Annotated[Path, Argument(metavar="FILE", help=f"{READ}; with --from-topics also rosbag2.")]
    to: Annotated[
        str, Option(metavar="LINK", help="ci, sbn, ground, another LINK or LINK:up, udp:HOST:PORT.")
    ]
    from_topics: Annotated[bool, Option("--from-topics", help="Make packets of its ROS messages.")] = False


class PaceOptions(NamedTuple):
    """How fast it is sent, and how often."""

    speed: Annotated[float | None, Option(parser=speed, help="Factor; default 1; max: no pauses.")] = None
    rate: Annotated[
        list[Any] | None,
        Option(parser=sending.rate, metavar="[ROUTE=]HZ", help="Send at even intervals, /cmd_vel=30."),
    ] = None
    fastest: Annotated[bool, Option("--max", hidden=True)] = False
    loop: Annotated[int | None, Option(parser=sending.loops, help="How often; default 1; 0: no end.")] = None


@headed("Selection")
class PartOptions(NamedTuple):
    """Which part of the recording is sent."""

    times: options.TimeOptions = options.TimeOptions()
    duration: Annotated[int | None, Option(parser=options.duration, hidden=True)] = None
    first: Annotated[int | None, Option("--count", "-n", parser=options.count, help="Send so many.")] = None
    route: Annotated[list[str] | None, Option(help="Only MsgIds, topics or keys, e.g. '0x18*'.")] = None

    def choice(self, selection: Selection) -> ReplaySelection:
        """Return these options and the selection in the form that pipelines take.

        Raises:
            ConfigError: both --end and --duration are given, or the end is not after the start.
        """
        from edoras_tools.pipelines.sending.replay import ReplaySelection

        if self.times.end and self.duration:
            raise ConfigError("--end and --duration both say when to stop; name one")
        period = self.times.period()
        if self.duration:
            period = replace(period, length_ns=self.duration)
        return ReplaySelection(selection, tuple(self.route or ()), period, self.first or 0)


class ChangeOptions(NamedTuple):
    """Changes of the packets."""

    write_headers: Annotated[str | None, Option(help="Another cFE's: 16, 12, extended, extended-v2.")] = None
    remap: Annotated[
        list[Any] | None, Option(parser=pair, metavar="A:=B", help="Send MsgId, topic or key A as B.")
    ] = None
    restamp: Annotated[bool, Option("--restamp", help="Set header stamps to the time of sending.")] = False


def _towards(send_options: SendOptions, text: str, bench: Workbench) -> SendOptions:
    """Return options with the receiver, and the values that it and the mission determine."""
    from edoras_tools.pipelines.sending.options import receiver

    to, target = receiver(text, bench.columns.context)
    return replace(send_options, to=to, target=send_options.target or target).placed(bench.mission)


@grouped
def replay(
    source: SourceOptions,
    pace: PaceOptions,
    part: PartOptions,
    change: ChangeOptions,
    ending: sending.EndingOptions,
    how: sending.SendingOptions,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Send a recording again: unchanged, faster, or changed.

    Bytes stay as captured unless an option changes them. In a terminal: space pauses, n sends the
    next datagram, q quits.
    """
    from edoras_tools.pipelines.sending import replay as pipeline
    from edoras_tools.pipelines.sending.run import Transmission
    from edoras_tools.wire.cfe import STANDARD

    settings = decoding.settings()
    send_options, faults = how.send_options(), how.faults.plan()
    choice = part.choice(filters.selection())
    send_options = replace(
        send_options,
        speed=1.0 if pace.speed in {None, inf} else pace.speed,
        rates=tuple(pace.rate or ()),
        unpaced=pace.fastest or pace.speed == inf,
        passes=1 if pace.loop is None else pace.loop,
    )
    pairs = list(change.remap or ())
    if source.from_topics:
        from edoras_tools.io.formats.rosbag2.reader import open_rosbag
        from edoras_tools.pipelines.sending.replay import load_topics

        bag = open_rosbag(source.file)
        bench = settings.workbench()
        send_options = _towards(send_options, source.to, bench)
        renamed = {"/" + old.removeprefix("/"): new for old, new in pairs if not old[:1].isdigit()}
        loaded = load_topics(bag, bench, send_options, choice, renamed)
        pairs = [(old, new) for old, new in pairs if old[:1].isdigit()]
    else:
        from edoras_tools.pipelines.workbench import open_files
        from edoras_tools.render.capture.watch import Followed

        quiet = ending.printing.quiet or ending.printing.json
        with closing(Followed(open_files([source.file]), quiet=quiet)) as recording:
            bench = settings.workbench(recording.info, [source.file])
            send_options = _towards(send_options, source.to, bench)
            loaded = pipeline.load_datagrams(recording, bench, send_options, choice)
    headers = pipeline.headers_named(change.write_headers) if change.write_headers else None
    read_as = bench.columns.context.options.headers
    extended = (headers or read_as or STANDARD).extended
    target = headers.msg_ids if headers else None
    names = pipeline.remapped(pairs, bench.mission, extended=extended, target=target)
    changes = pipeline.changes_for(
        send_options, names, bench.mission, bench.types, restamp=change.restamp, headers=headers
    )
    if headers is not None:
        loaded, bench = loaded.numbered(bench.mission.msg_ids, headers.msg_ids), bench.with_headers(headers)
        send_options = replace(send_options, headers=headers)
    transmission = Transmission.of(loaded, send_options, bench.mission, changes)
    sending.carry_out(transmission, bench, faults, ending, inputs=(source.file,))
