"""``edoras play``: a recording to a ROS 2 graph."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import asdict
from typer import Argument, Exit, Option

from edoras_tools.cli import options
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.output import INTERRUPTED, LOST, print_json, say, tell
from edoras_tools.cli.replay import pair
from edoras_tools.cli.sending import factor, loops
from edoras_tools.io.formats.table import READ_PACKED

if TYPE_CHECKING:
    from edoras_tools.addons.ros_verbs.playing import PlayRequest

_DELAY_NS = 5_000_000_000


class PlayOptions(NamedTuple):
    """The played part of a recording, and the settings of playing."""

    topic: Annotated[list[str] | None, Option(help="Only topics that match, e.g. '/robot_*'.")] = None
    remap: Annotated[list[Any] | None, Option(parser=pair, metavar="A:=B", help="Publish A as B.")] = None
    times: options.TimeOptions = options.TimeOptions()
    speed: Annotated[float | None, Option(parser=factor, help="Factor; default 1.")] = None
    clock: Annotated[
        float | None, Option(parser=factor, metavar="[=HZ]", help="Also publish its time, at 40 Hz.")
    ] = None
    loop: Annotated[int | None, Option(parser=loops, help="How often; default 1; 0: no end.")] = None
    paused: Annotated[bool, Option("--paused", help="Paused at first: n next, space, q quits.")] = False
    delay: Annotated[
        int | None, Option(parser=options.duration, help="Wait for subscriptions at most; 5s.")
    ] = None

    def request(self) -> PlayRequest:
        """Return these options in the form that pipelines take."""
        from edoras_tools.addons.ros_verbs.playing import PlayRequest

        passes, delay = 1 if self.loop is None else self.loop, _DELAY_NS if self.delay is None else self.delay
        topics, renamed, period = tuple(self.topic or ()), dict(self.remap or ()), self.times.period()
        speed, clock = self.speed or 1.0, self.clock or 0.0
        return PlayRequest(topics, renamed, period, speed, clock, passes, self.paused, delay)


@grouped
def play(
    *,
    files: Annotated[list[Path], Argument(metavar="FILE...", help=f"{READ_PACKED}.")],
    graph: RosOptions,
    how: PlayOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Publish a recording's messages in ROS 2.

    With the quality of service that their publishers had, at the times of the recording, kept as replay
    keeps them.
    """
    from edoras_tools.addons.ros_verbs import playing
    from edoras_tools.middleware.opening import open_graph, usual, usual_domain
    from edoras_tools.pipelines.interrupt import Keys
    from edoras_tools.pipelines.messages import open_inputs
    from edoras_tools.render.capture.watch import Followed
    from edoras_tools.render.sending.status import send_status

    (json, quiet), (ros, domain, more), request = printing, graph, how.request()
    ros, domain = ros or usual(), usual_domain() if domain is None else domain
    source, bench = open_inputs(files, decoding.settings())
    with closing(Followed(source, quiet=quiet or json)) as recording:
        loaded = playing.load_messages(recording, bench, request)
    name = f"{ros}, domain {domain}"
    node = open_graph(ros, bench.types, "edoras_play", domain=domain, options=dict(more or ()))
    if not (quiet or json):
        say(f"playing {len(loaded.out):,} messages on {len(loaded.topics)} topics ({name}); Ctrl-C ends")
    keys = Keys() if request.paused or (sys.stdin is not None and sys.stdin.isatty()) else None
    total = len(loaded.out) * request.passes or None
    with send_status(total, quiet=quiet or json, keys=bool(keys)) as watcher:
        report = playing.play(loaded, node, request, bench.mission, name=name, keys=keys, watcher=watcher)
    summary = report.summary()
    if json:
        topics = [{"topic": item.topic, "type": item.type, **asdict(item.qos)} for item in loaded.topics]
        names = "sent", "rate_achieved_hz", "duration_s", "lateness_us", "errors", "notes", "interrupted"
        figures = {key: summary[key] for key in names}
        print_json({"graph": name, "total": report.total, **figures, "topics": topics})
    elif not quiet:
        late = " us, ".join(f"{key} {value}" for key, value in summary["lateness_us"].items())
        sys.stdout.write(
            f"published {report.sent:,} messages in {summary['duration_s']:.1f} s, late by {late} us\n"
        )
    errors = (f"{count:,} not published: {why}" for why, count in report.errors.items())
    tell(*summary["notes"], *errors)
    if report.failure is not None:
        raise report.failure
    if report.errors or (report.signalled and report.total):
        raise Exit(LOST if report.errors else INTERRUPTED)
