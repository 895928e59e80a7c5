"""``edoras experiment``: many runs of a system under several settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from edoras_tools.cli import options, sending
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.output import print_json, print_view


@grouped
def experiment(
    *,
    plan: Annotated[Path, Argument(metavar="PLAN.yaml", help="What is tried, and how often.")],
    output: Annotated[
        Path | None, Option("--output", "-o", help="Folder of the runs; default: the plan's name.")
    ] = None,
    yes: sending.Yes = False,
    printing: options.PrintOptions,
) -> None:
    """Make many runs, and say what each setting loses.

    Each run is recorded and diagnosed in the folder. Runs that are there are not made again, so the same
    command resumes what was broken off.

    For example, PLAN.yaml: {scenario: rover, settings: {rate: [5, 10]}, runs: 5..40, width: 1%}
    """
    from edoras_tools.addons.lab.experiment import Experiment, load_plan
    from edoras_tools.addons.lab.views.sweep import cells_table, step_status
    from edoras_tools.io.net.sockets import parse_endpoint

    plan_ = load_plan(plan)
    if plan_.target:
        sending.confirm_targets(parse_endpoint(plan_.target), confirmed=yes)
    carried_out = Experiment(plan_, output or plan.with_suffix(""))
    with step_status(quiet=printing.quiet) as trying:
        report = carried_out.run(trying)
    if printing.json:
        print_json(report)
    elif not printing.quiet:
        print_view(lambda width: cells_table(report, width))
