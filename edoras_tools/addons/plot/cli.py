"""``edoras plot``: fields over time, in the terminal or as a picture."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import file_progress, print_json, topics_read
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import FILE_SUFFIXES, READ_PACKED
from edoras_tools.words import plural

if TYPE_CHECKING:
    from edoras_tools.render.plot.figure import Figure

_PICTURES = (".svg", ".png", ".html")
_PACKED = (".gz", ".zst")


def _is_file(text: str) -> bool:
    """Return whether an argument is a file, not a field: it exists, or has the suffix of a capture."""
    path = Path(text)
    suffix = path.with_suffix("").suffix if path.suffix in _PACKED else path.suffix
    return text == "-" or suffix in FILE_SUFFIXES or path.exists()


@grouped
def plot(
    *,
    arguments: Annotated[
        list[str] | None,
        Argument(metavar="FILE... FIELD...", help=f"{READ_PACKED}; /cmd_vel.linear.x, rate:/cmd_vel."),
    ] = None,
    read: Annotated[list[Path] | None, Option("--read", "-r", hidden=True)] = None,
    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            parser=options.recording_path,
            metavar="FILE",
            help="A picture (.svg, .png) or a page (.html).",
        ),
    ] = None,
    force: recordings.Force = False,
    bare: Annotated[bool, Option("--bare", help="No rates, losses and events beneath the fields.")] = False,
    printing: options.PrintOptions,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Plot fields over time, with rates, losses and events.

    A FIELD is /cmd_vel.linear.x, '/cmd_vel.linear.*' or /imu.covariance[4]; each has its own panel; with a
    comma, two share one. Without FIELD: the rates of all topics. Several files are laid over each other.
    """
    from edoras_tools.addons.plot.series import open_recordings, parse_request, read_plot
    from edoras_tools.io.outputs import check_new

    items = arguments or []
    files = [*(read or ()), *(Path(item) for item in items if _is_file(item))]
    if not files:
        raise ConfigError("name the input to plot: FILE... FIELD...")
    requests = [parse_request(item) for item in items if not _is_file(item)]
    if output is not None:
        _check(output)
        check_new(output, files, force=force)
    scope = part.scope()
    sources = open_recordings(files, decoding.settings(), scope)
    names = [file.name for file in files]
    names = names if len({*names}) == len(names) else [str(file) for file in files]
    quiet = printing.quiet or printing.json
    with file_progress(names, quiet=quiet) as bar:
        report = read_plot(sources, names, requests, scope, bare=bare, progress=bar)
    if output is not None:
        size = _write(report.figure, output)
    if printing.json:
        print_json({**report.summary(), "output": None if output is None else str(output)})
    elif output is None:
        _print(report.figure)
    elif not printing.quiet:
        from edoras_tools import words

        lines = sum(len(panel.lines) for panel in report.figure.panels)
        sys.stderr.write(f"{output}: {report.figure.title}, {plural(lines, 'line')}, {words.size(size)}\n")
    for source in sources:
        topics_read(source)


def _check(output: Path) -> None:
    """Check that a picture can be written.

    Raises:
        ConfigError: its suffix is unknown, or a library is not installed.
    """
    if output.suffix.lower() not in _PICTURES:
        raise ConfigError(f"{output}: {output.suffix or 'no suffix'} is no picture; use .svg, .png or .html")
    if output.suffix.lower() == ".png":
        from edoras_tools.render.plot.svg import need_png

        need_png()


def _write(figure: Figure, output: Path) -> int:
    """Write a picture; return its size in bytes."""
    from edoras_tools.addons.plot.page import plot_page
    from edoras_tools.render.plot.svg import PLOT_WIDTH, plot_svg, png

    suffix = output.suffix.lower()
    picture = plot_page(figure) if suffix == ".html" else plot_svg(figure)
    content = png(picture, 2 * PLOT_WIDTH) if suffix == ".png" else picture
    return recordings.write_page(content, output)


def _print(figure: Figure) -> None:
    from edoras_tools.render.plot.terminal import plot_lines
    from edoras_tools.render.terminal.palette import FILE_WIDTH, detect_terminal, output_console

    terminal = detect_terminal(sys.stdout)
    width = 100 if terminal.width == FILE_WIDTH else terminal.width
    for line in plot_lines(figure, width, colour=terminal.colour):
        output_console().print(line, no_wrap=True, crop=False)
