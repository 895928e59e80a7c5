"""``edoras trace``: the way of one message, hop by hop."""

from __future__ import annotations

import sys
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Annotated, NamedTuple

from typer import Argument, Exit, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import LOST, no_datagrams, tell
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.output import file_progress, print_json, print_view
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import READ_PACKED
from edoras_tools.io.outputs import check_new

if TYPE_CHECKING:
    from edoras_tools.pipelines.doctor.trace import TraceRequest, Tracing

_PICTURES = (".svg", ".html", ".mmd")


class WhichOptions(NamedTuple):
    """What to follow, where it is no packet."""

    topic: Annotated[str | None, Option(help="A topic: its rounds as a diagram; one message: --nth.")] = None
    nth: Annotated[int | None, Option(parser=options.count, metavar="N", help="Its N-th message.")] = None
    lost: Annotated[
        int | None,
        Option(parser=options.count, metavar="N", help="The N-th that was lost; doctor --list-lost."),
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
        Path | None,
        Option("--output", "-o", metavar="FILE", help="Write .svg, .html, or .mmd for Mermaid."),
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
    from edoras_tools.pipelines.doctor.doctor import examine, profile_with
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.doctor.trace import Tracing

    files, request = _request(arguments or [], read or [], which)
    scope = Scope(period=times.period())
    if output is not None:
        _check(output, request)
        check_new(output, files, force=force)
    quiet = printing.quiet or printing.json
    with file_progress(files, quiet=quiet) as bar:
        inputs = InputOptions(FileOptions(files))
        source, bench = open_input(inputs, decoding.settings(constants=True), aligned=True, progress=bar)
        tracing = Tracing(bench.columns.context, profile_with(decoding.constants), request)
        findings = examine(source, bench, scope=scope, progress=bar, examination=tracing)
    no_datagrams(source)
    if findings.failure is not None:
        tell(str(findings.failure))
    tracing.check()
    zero_ns = findings.zero_ns
    if output is not None:
        _write(tracing, zero_ns, source.info.name, output)
    if printing.json:
        print_json(
            {
                "source": source.info.name,
                "zero_ns": zero_ns,
                "trace": tracing.trace.as_json() if tracing.trace else None,
                "timing": tracing.timing.as_json() if tracing.timing else None,
                "output": None if output is None else str(output),
            }
        )
    elif output is None:
        _print(tracing, zero_ns)
    for warning in findings.diagnosis.capture.warnings:
        tell(warning)
    if tracing.trace is not None and tracing.trace.ended.ending in {"lost", "unaccounted"}:
        raise Exit(LOST)


def _request(arguments: list[str], read: list[Path], which: WhichOptions) -> tuple[list[Path], TraceRequest]:
    """Return the files, and what to follow in them.

    Raises:
        ConfigError: a file is missing, or it is not said what to follow, or said twice.
    """
    from edoras_tools.pipelines.doctor.trace import TraceRequest

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
        ConfigError: its suffix is unknown, or not for what is asked for.
    """
    suffix = output.suffix.lower()
    if suffix not in _PICTURES:
        raise ConfigError(f"{output}: {suffix or 'no suffix'} is no picture; use .svg, .html or .mmd")
    if suffix == ".mmd" and not (request.packet or request.nth or request.lost):
        raise ConfigError(f"{output}: Mermaid draws one message: add --nth, or use .svg or .html")


def _print(tracing: Tracing, zero_ns: int) -> None:
    from rich.text import Text

    from edoras_tools.render.doctor.trace import diagram, ladder

    message, timing = tracing.trace, tracing.timing

    def view(width: int) -> Text:
        lines = ladder(message, zero_ns, width) if message else []
        return Text("\n").join(lines or (diagram(timing, zero_ns, width) if timing else []))

    print_view(view, is_whole=True)


def _write(tracing: Tracing, zero_ns: int, name: str, output: Path) -> None:
    """Write a picture, a page or Mermaid."""
    import shlex

    from edoras_tools.render.doctor.report import Made
    from edoras_tools.render.doctor.report.pictures import trace_page, trace_svg
    from edoras_tools.render.doctor.trace import trace_mermaid

    subject = tracing.trace or tracing.timing
    assert subject is not None
    if output.suffix.lower() == ".mmd":
        assert tracing.trace is not None
        text = "\n".join([*trace_mermaid(tracing.trace, zero_ns), ""])
    elif output.suffix.lower() == ".svg":
        text = trace_svg(subject, zero_ns, name)
    else:
        text = trace_page(subject, zero_ns, name, Made(shlex.join(["edoras", *sys.argv[1:]]), time_ns()))
    recordings.write_page(text, output)
