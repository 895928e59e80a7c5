"""``edoras hz``: the rate of a topic, hop by hop."""

from __future__ import annotations

import sys
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from edoras_tools.cli import options
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import no_datagrams, tell
from edoras_tools.cli.inputs import FileOptions, InputOptions, LiveOptions, open_input
from edoras_tools.cli.output import file_progress, print_json
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import READ_PACKED

if TYPE_CHECKING:
    from edoras_tools.pipelines.doctor.trace import Tracing

_EVERY_NS = 1_000_000_000


class _Printer:
    """Prints the rates each time that live traffic was judged."""

    def __init__(self, tracing: Tracing) -> None:
        self._tracing = tracing

    def update(self, _run: object, /) -> None:
        """Print them as they are now."""
        from edoras_tools.render.doctor.trace import rate_lines

        for rates in self._tracing.rates:
            sys.stdout.write(f"{rate_lines(rates)[0]}\n")
        sys.stdout.flush()


@grouped
def hz(
    *,
    arguments: Annotated[
        list[str] | None, Argument(metavar="[FILE]... TOPIC", help=f"{READ_PACKED}; a topic or MsgId.")
    ] = None,
    topic: Annotated[str | None, Option(hidden=True)] = None,
    interface: Annotated[
        str | None, Option("--interface", "-i", metavar="IFACE", help="Live, of it.")
    ] = None,
    listen: Annotated[list[str] | None, Option(hidden=True)] = None,
    window: Annotated[
        int | None, Option("--window", "-w", parser=options.count, help="Messages; the usual is 10,000.")
    ] = None,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show the rate of a topic, hop by hop.

    At the publisher, behind CI or the pipe, and where it comes out; live once a second, as ros2 topic hz.
    """
    from edoras_tools.diagnosis.rounds import USUAL_WINDOW
    from edoras_tools.pipelines.doctor.doctor import Pace, examine, profile_with
    from edoras_tools.pipelines.doctor.trace import TraceRequest, Tracing
    from edoras_tools.render.doctor.trace import rate_lines

    words = list(arguments or ())
    if topic is None:
        if not words:
            raise ConfigError("name the topic: edoras hz FILE /cmd_vel")
        topic = words.pop()
    inputs = InputOptions(FileOptions([Path(item) for item in words]), LiveOptions(interface, listen))
    is_live = bool(interface or listen)
    if not is_live and not words:
        raise ConfigError(f"name the input: edoras hz FILE {topic}, or -i IFACE")
    quiet = printing.quiet or printing.json or is_live
    with file_progress(words, quiet=quiet) as bar:
        source, bench = open_input(inputs, decoding.settings(constants=True), aligned=True, progress=bar)
        request = TraceRequest(topic=topic, window=window or USUAL_WINDOW)
        tracing = Tracing(bench.columns.context, profile_with(decoding.constants), request)
        watcher = _Printer(tracing) if is_live and not printing.json else None
        pace = Pace(monotonic_ns, _EVERY_NS if is_live else 0, watcher=watcher)
        findings = examine(source, bench, pace=pace, progress=bar, examination=tracing)
    if not is_live:
        no_datagrams(source)
    tracing.check()
    if printing.json:
        print_json({"source": source.info.name, "topics": [item.as_json() for item in tracing.rates]})
    else:
        for rates in tracing.rates:
            sys.stdout.write("\n".join([*rate_lines(rates), ""]))
    for warning in findings.diagnosis.capture.warnings:
        tell(warning)
    if findings.failure is not None:
        raise findings.failure
