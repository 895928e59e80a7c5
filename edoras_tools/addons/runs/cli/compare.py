"""``edoras compare``: are later runs worse than earlier ones?"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, Exit, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.options import share
from edoras_tools.cli.output import LOST, file_progress, print_json, print_view, tell
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.addons.runs.differences import DifferenceLimits


def _of_route(read: Callable[[str], Any]) -> Callable[[str], tuple[str, Any]]:
    """Return a parser of ``[ROUTE=]VALUE``."""

    def value(text: str) -> tuple[str, Any]:
        route, _, rest = text.rpartition("=")
        return route.removeprefix("/"), read(rest)

    return value


class LimitOptions(NamedTuple):
    """Accepted differences, and limits of later runs."""

    tolerance: Annotated[
        list[Any] | None,
        Option(
            parser=options.room,
            metavar="[FIELD=]VALUE",
            help="Percent of rates and delays, 10; or of a field.",
        ),
    ] = None
    max_loss: Annotated[
        list[Any] | None,
        Option(parser=_of_route(share), metavar="[ROUTE=]SHARE", help="Later runs may lose so much: 1%."),
    ] = None
    max_delay: Annotated[
        list[Any] | None,
        Option(
            parser=_of_route(options.duration), metavar="[ROUTE=]TIME", help="99 % may take so long: 300ms."
        ),
    ] = None
    junit: Annotated[Path | None, Option(help="Also write the results as JUnit XML.")] = None
    force: recordings.Force = False

    def bounds(self) -> DifferenceLimits:
        """Return these options in the form that the comparison takes."""
        from edoras_tools.addons.runs.differences import DifferenceLimits

        rooms = dict(self.tolerance or ())
        delays = [(route, time_ns / 1e6) for route, time_ns in self.max_delay or ()]
        return DifferenceLimits(rooms.pop("", 10.0) / 100, rooms, self.max_loss or (), delays)


@grouped
def compare(
    *,
    runs: Annotated[
        list[Path], Argument(metavar="RUN...", help="Earlier runs; without --against also one later.")
    ],
    against: Annotated[list[Path] | None, Option(help="Later runs: files or folders.")] = None,
    limits: LimitOptions,
    printing: options.PrintOptions,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Compare runs by route: are the later ones worse?

    Compared are rates, loss, latency, sizes, values, findings and verdicts: edoras compare GOOD BAD, or
    edoras compare RUN... --against RUN --against FOLDER. Of many runs, means with the interval of their
    difference.

    Exit code 3 means that the later runs are worse. To compare two captures of the same traffic, use doctor
    --against.
    """
    from edoras_tools.addons.runs.check import write_junit
    from edoras_tools.addons.runs.differences import RunSummary, compare_runs, comparison_json
    from edoras_tools.addons.runs.run import read_runs
    from edoras_tools.io.outputs import check_new

    if against is None and len(runs) != 2:
        raise ConfigError(
            "two runs are compared: edoras compare GOOD BAD; more with --against: RUN... --against RUN"
        )
    earlier, later = (runs, against) if against else (runs[:1], runs[1:])
    if limits.junit is not None:
        check_new(limits.junit, [*earlier, *later], force=limits.force)
    json, quiet = printing
    with file_progress([*earlier, *later], quiet=quiet or json) as bar:
        settings, scope = decoding.settings(), part.scope()
        good, bad = (
            [RunSummary.of(run) for run in read_runs(paths, settings, scope=scope, progress=bar)]
            for paths in (earlier, later)
        )
    points = compare_runs(good, bad, limits.bounds())
    report = comparison_json(good, bad, points)
    if limits.junit is not None:
        results = [item.result() for item in points]
        write_junit(limits.junit, results, ("compare", report["good"]["source"], report["bad"]["source"]))
    if json:
        print_json(report)
    elif not quiet or report["worse"]:
        from edoras_tools.addons.runs.views import runs_view

        print_view(lambda width: runs_view(report, width))
    for run in (*good, *bad):
        for warning in run.info["warnings"]:
            tell(f"{run.info['source']}: {warning}")
    if report["worse"]:
        raise Exit(LOST)
