"""``edoras doctor --against`` and ``--bag``: a capture compared with another one, or with ROS bags."""

from __future__ import annotations

from functools import partial
from time import monotonic_ns
from typing import TYPE_CHECKING

from typer import Exit

from edoras_tools.addons.runs.against import BagComparison, against_bag, against_capture, bridge_counts, diff
from edoras_tools.addons.runs.views import comparison_table
from edoras_tools.cli.doctor import print_diagnosis
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.output import LOST, file_progress, print_json, print_view, tell
from edoras_tools.diagnosis.balance import Chain, chains
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.pipelines.doctor.doctor import Pace, examine
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.render.doctor import chain_table

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.cli import options
    from edoras_tools.pipelines.doctor.scope import Scope


def against(
    settings: Settings, scope: Scope, files: list[Path], other: Path, printing: options.PrintOptions
) -> None:
    """Compare captures with another one of the same traffic."""
    if not files:
        raise ConfigError("--against needs two captures: edoras doctor FIRST --against SECOND")
    first = open_files(files)
    quiet = printing.quiet or printing.json
    with file_progress([first.info.name], quiet=quiet) as bar:
        comparison = diff(first, open_files([other]), settings.workbench(first.info), scope, bar)
    if printing.json:
        print_json(comparison.as_json())
    elif comparison.common:
        print_view(lambda width: comparison_table(comparison, width))
    if not comparison.common:
        names = ", ".join(map(str, files))
        raise CaptureError(
            f"{names} and {other}: no datagram in common; name two captures of the same traffic"
        )
    if comparison.lost:
        raise Exit(LOST)


def bags(
    settings: Settings,
    scope: Scope,
    inputs: InputOptions,
    others: list[Path],
    printing: options.PrintOptions,
    *,
    verbose: bool,
) -> None:
    """Compare a capture, or the first of several bags, with bags of the ROS side."""
    files, judged = inputs.paths, None
    if not files and len(others) < 2:
        raise ConfigError("--bag needs a capture, or a second bag: edoras doctor CAPTURE --bag BAG")
    if files:
        quiet = printing.quiet or printing.json
        with file_progress(files, quiet=quiet) as bar:
            source, bench = open_input(inputs, settings, aligned=True, progress=bar)
            comparisons = against_capture(source, others, bench, scope, bar)
            if all(path.is_file() or path.is_dir() for path in files):  # a pipe can be read only once
                source, bench = open_input(inputs, settings, aligned=True, progress=bar)
                judged = examine(source, bench, scope=scope, pace=Pace(monotonic_ns), progress=bar)
    elif scope.selection or scope.period:
        raise ConfigError("--start, --end and what selects packets have no effect on bags alone")
    else:
        comparisons = against_bag(others[0], others[1:], settings.workbench().types)
    lost = sum(item.comparison.lost for item in comparisons)
    ways: list[Chain] = []
    if judged:
        ways = chains(judged.diagnosis.balance, judged.diagnosis.topics, bridge_counts(comparisons))
        if not printing.json:
            print_diagnosis(judged.diagnosis, source.info.name, quiet=printing.quiet, verbose=verbose)
    if printing.json:
        compared, chained = ([item.as_json() for item in rows] for rows in (comparisons, ways))
        whole = {"lost": lost, "bags": compared, "chains": chained}
        print_json({**whole, "diagnosis": judged.summary() if judged else None})
    else:
        _print_bags(comparisons, ways, ", ".join(map(str, files or others[:1])))
    if judged:
        tell(*judged.warnings)
    if lost or (judged and judged.diagnosis.bad):
        raise Exit(LOST)


def _print_bags(comparisons: list[BagComparison], ways: list[Chain], first: str) -> None:
    for item in comparisons:
        print_view(f"first: {first}, second: {item.bag}")
        print_view(partial(comparison_table, item.comparison))
        if item.left_out:
            tell(f"{item.bag}: {item.left_out:,} messages do not fit their type and are not compared")
    if ways:
        print_view(lambda width: chain_table(ways, width))
