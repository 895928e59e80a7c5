"""``edoras compare``: is the second run worse than the first?"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Exit, Option

from edoras_tools.cli import options
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import LOST, tell
from edoras_tools.cli.output import file_progress, print_json, print_view


@grouped
def compare(
    *,
    good: Annotated[Path, Argument(metavar="GOOD", help="A good run.")],
    bad: Annotated[Path, Argument(metavar="BAD", help="The run to compare with it.")],
    tolerance: Annotated[float, Option(min=0, help="Percent that rates and latencies may differ.")] = 10,
    json: options.Json = False,
    quiet: options.Quiet = False,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Compare runs by route: are the later ones worse?

    Compared are rates, loss, latency, sizes, findings and verdicts.

    Exit code 3 means that the second run is worse. To compare two captures of the same traffic, use doctor
    --against.
    """
    from edoras_tools.addons.runs.comparison import compare_runs

    scope = part.scope()
    with file_progress([good.name], quiet=quiet or json) as bar:
        found = compare_runs(
            good, bad, decoding.settings(), tolerance=tolerance / 100, scope=scope, progress=bar
        )
    if json:
        print_json(found.as_json())
    else:
        from edoras_tools.addons.runs.compare_views import runs_view

        print_view(runs_view(found.good, found.bad, found.changes))
    for run in (found.good, found.bad):
        for warning in run.info["warnings"]:
            tell(f"{run.info['source']}: {warning}")
    if found.worse:
        raise Exit(LOST)
