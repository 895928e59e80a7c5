"""``edoras trace``: the way of one message, hop by hop; ``edoras hz``: the rate of a topic, hop by hop."""

from __future__ import annotations

import sys
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, NamedTuple

from typer import Argument, Option

from edoras_tools import doors
from edoras_tools.cli import options, recordings
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.inputs import FileOptions, InputOptions, LiveOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, file_progress, no_datagrams, print_json, print_view, tell
from edoras_tools.errors import ConfigError, NoDatagramsError
from edoras_tools.io.formats.table import READ_PACKED
from edoras_tools.io.outputs import check_new

if TYPE_CHECKING:
    from edoras_tools.addons.trace.tracing import TraceRequest, Tracing
    from edoras_tools.pipelines.workbench import Settings

_PICTURES = (".svg", ".html", ".mmd")
_EVERY_NS = 1_000_000_000


class WhichOptions(NamedTuple):
    """The subject, if it is no packet."""

    topic: Annotated[str | None, Option(help="Draw the rounds of this topic; with --nth one message.")] = None
    nth: Annotated[int | None, Option(parser=options.count, metavar="N", help="N-th one of --topic.")] = None
    lost: Annotated[
        int | None, Option(parser=options.count, metavar="N", help="The N-th of doctor --list-lost.")
    ] = None


@grouped
def trace(
    *,
    arguments: Annotated[
        list[str] | None,
        Argument(metavar="FILE... [PACKET]", help=f"{READ_PACKED}; a packet's number, as sniff shows it."),
    ] = None,
    read: Annotated[list[Path] | None, Option("--read", "-r", hidden=True)] = None,
    which: WhichOptions,
    output: Annotated[
        Path | None, Option("--output", "-o", metavar="FILE", help="Write .svg, .html, or .mmd for Mermaid.")
    ] = None,
    force: recordings.Force = False,
    times: options.TimeOptions = options.TimeOptions(),
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Follow one message hop by hop, or a topic's rounds.

    Through bridge, CI, pipe, application and TO or SBN: where it was at what time, where it ended, and what
    shows that. Exit code 3: it was lost.
    """
    from edoras_tools.addons.trace.tracing import Tracing
    from edoras_tools.pipelines.doctor import Scope, examine

    files, request = _request(arguments or [], read or [], which)
    scope = Scope(period=times.period())
    if output is not None:
        _check(output, request)
        check_new(output, files, force=force)
    quiet = printing.quiet or printing.json
    with file_progress(files, quiet=quiet) as bar:
        inputs = InputOptions(FileOptions(files))
        source, bench = open_input(inputs, decoding.settings(constants=True), aligned=True, progress=bar)
        tracing = Tracing(bench.columns.context, request)
        findings = examine(source, bench, scope=scope, progress=bar, examination=tracing)
    no_datagrams(source)
    if findings.failure is not None:
        tell(str(findings.failure))
    tracing.check()
    zero_ns = findings.zero_ns
    if output is not None:
        _write(tracing, zero_ns, source.info.name, output)
    if printing.json:
        subjects = {"trace": tracing.trace, "timing": tracing.timing}
        whole = {name: item.as_json() if item else None for name, item in subjects.items()}
        where = {"output": None if output is None else str(output)}
        print_json({"source": source.info.name, "zero_ns": zero_ns, **whole, **where})
    elif output is None:
        _print(tracing, zero_ns)
    trace = tracing.trace
    end(*findings.warnings, lost=trace is not None and trace.ended.ending in {"lost", "unaccounted"})


def _request(arguments: list[str], read: list[Path], which: WhichOptions) -> tuple[list[Path], TraceRequest]:
    """Return the files, and the subject in them.

    Raises:
        ConfigError: a file is missing, or no subject is given, or two.
    """
    from edoras_tools.addons.trace.tracing import TraceRequest

    words, packet, (topic, nth, lost) = list(arguments), None, which
    if words and words[-1].isdecimal() and not Path(words[-1]).exists():
        packet = options.count(words.pop())
    if len(words) > 1 and topic is None and words[-1].startswith("/") and not Path(words[-1]).exists():
        topic = words.pop()
    files = [*read, *map(Path, words)]
    if not files:
        raise ConfigError("name the file, and what to follow: edoras trace FILE 417")
    if sum(item is not None for item in (packet, nth, lost)) > 1 or (packet is not None and topic):
        raise ConfigError("name one message: a packet, --topic with --nth, or --lost")
    if packet is None and topic is None and lost is None:
        raise ConfigError(
            "say which message: a packet's number, --topic /cmd_vel --nth 12, or --lost 3"
            if nth is None
            else f"--nth {nth} of which topic? Add --topic"
        )
    return files, TraceRequest(packet, topic, nth, lost)


def _check(output: Path, request: TraceRequest) -> None:
    """Check that a picture can be written.

    Raises:
        ConfigError: its suffix is unknown, or does not fit the subject.
    """
    suffix = output.suffix.lower()
    if suffix not in _PICTURES:
        raise ConfigError(f"{output}: {suffix or 'no suffix'} is no picture; use .svg, .html or .mmd")
    if suffix == ".mmd" and not (request.packet or request.nth or request.lost):
        raise ConfigError(f"{output}: Mermaid draws one message: add --nth, or use .svg or .html")


def _print(tracing: Tracing, zero_ns: int) -> None:
    from rich.text import Text

    from edoras_tools.addons.trace.views import diagram, ladder

    message, timing = tracing.trace, tracing.timing

    def view(width: int) -> Text:
        lines = ladder(message, zero_ns, width) if message else []
        return Text("\n").join(lines or (diagram(timing, zero_ns, width) if timing else []))

    print_view(view, is_whole=True)


def _write(tracing: Tracing, zero_ns: int, name: str, output: Path) -> None:
    """Write a picture, a page or Mermaid."""
    from edoras_tools.addons.trace.views import trace_mermaid, trace_page, trace_svg

    subject = tracing.trace or tracing.timing
    assert subject is not None
    if output.suffix.lower() == ".mmd":
        assert tracing.trace is not None
        text = "\n".join([*trace_mermaid(tracing.trace, zero_ns), ""])
    elif output.suffix.lower() == ".svg":
        text = trace_svg(subject, zero_ns, name)
    else:
        text = trace_page(subject, zero_ns, name, recordings.page_origin())
    recordings.write_page(text, output)


class _Printer:
    """Prints the rates after each judgement of live traffic."""

    def __init__(self, tracing: Tracing) -> None:
        self._tracing = tracing

    def update(self, _run: object, /) -> None:
        """Print the present rates."""
        from edoras_tools.addons.trace.views import rate_lines

        for rates in self._tracing.rates:
            sys.stdout.write(f"{rate_lines(rates)[0]}\n")
        sys.stdout.flush()


class RateOptions(NamedTuple):
    """The live input: traffic, or a ROS 2 graph."""

    interface: Annotated[
        str | None, Option("--interface", "-i", metavar="IFACE", help="Capture here, and print each second.")
    ] = None
    listen: Annotated[list[str] | None, Option(hidden=True)] = None
    duration: options.Duration = None
    graph: RosOptions = RosOptions()
    window: Annotated[
        int | None, Option("--window", "-w", parser=options.count, help="Messages; default 10,000.")
    ] = None


@grouped
def hz(
    *,
    arguments: Annotated[
        list[str] | None,
        Argument(metavar="[FILE]... [TOPIC]", help=f"{READ_PACKED}; a topic or MsgId, else every topic."),
    ] = None,
    topic: Annotated[str | None, Option(hidden=True)] = None,
    live: RateOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show the rate of a topic, hop by hop.

    At the publisher, behind CI or the pipe, and where it comes out; live once a second, as ros2 topic hz.
    Of a graph (--ros) or a recording of ROS messages: the rates of topics, in its output.
    """
    words = list(arguments or ())
    options.check_duration(live.duration, [Path(item) for item in words if Path(item).exists()])
    if live.graph.ros:
        doors.part("graph_hz")(words, live.graph, live.duration, live.window, decoding, json=printing.json)
        return
    if topic is None and words and not (words[-1] == "-" or Path(words[-1]).exists()):
        topic = words.pop()
    try:
        _hop_rates(words, topic, live, printing, decoding.settings(constants=True))
    except NoDatagramsError:
        doors.part("graph_hz")(arguments or (), live.graph, None, live.window, decoding, json=printing.json)


def _hop_rates(
    words: list[str], topic: str | None, live: RateOptions, printing: options.PrintOptions, settings: Settings
) -> None:
    """Print the rates of a topic, or of all topics, at each hop.

    Raises:
        NoDatagramsError: the input is a recording of ROS messages.
    """
    from edoras_tools.addons.trace.rounds import USUAL_WINDOW
    from edoras_tools.addons.trace.tracing import TraceRequest, Tracing
    from edoras_tools.pipelines.doctor import Pace, examine

    interface, listen, duration, _, window = live
    is_live = bool(interface or listen)
    if not is_live and not words:
        raise ConfigError(f"name an input that exists: edoras hz FILE {topic or '/cmd_vel'}, or -i IFACE")
    inputs = InputOptions(FileOptions([Path(item) for item in words]), LiveOptions(interface, listen))
    quiet = printing.quiet or printing.json or is_live
    with file_progress(words, quiet=quiet) as bar:
        source, bench = open_input(inputs, settings, aligned=True, progress=bar)
        request = TraceRequest(topic=topic, window=window or USUAL_WINDOW)
        tracing = Tracing(bench.columns.context, request)
        watcher = _Printer(tracing) if is_live and not printing.json else None
        pace = Pace(monotonic_ns, _EVERY_NS if is_live else 0, duration or 0, watcher)
        findings = examine(source, bench, pace=pace, progress=bar, examination=tracing)
    if not is_live:
        no_datagrams(source)
    tracing.check()
    _print_rates(tracing, source.info.name, printing, is_whole=topic is not None)
    end(*findings.warnings, failure=findings.failure)


def _print_rates(tracing: Tracing, name: str, printing: options.PrintOptions, *, is_whole: bool) -> None:
    """Print the rates of a file, or those at the end; of one topic in full, else one line for each topic."""
    from edoras_tools.addons.trace.views import rate_lines

    if printing.json:
        print_json({"source": name, "topics": [item.as_json() for item in tracing.rates]})
        return
    for rates in tracing.rates:
        lines = rate_lines(rates)
        sys.stdout.write("\n".join([*(lines if is_whole else lines[:1]), ""]))
