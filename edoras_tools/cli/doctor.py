"""``edoras doctor``: says what is wrong on a link, where and why."""

from __future__ import annotations

import shlex
import sys
from contextlib import nullcontext
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, NamedTuple

from typer import Option

from edoras_tools import doors
from edoras_tools.cli import options
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.options import grouped, share
from edoras_tools.cli.output import end, file_progress, no_datagrams, print_csv, print_json, print_view
from edoras_tools.errors import ConfigError
from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.workbench import Settings

_EVERY_NS = 1_000_000_000


class Listing(StrEnum):
    """Formats of the list of lost messages."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"


class TaskOptions(NamedTuple):
    """The task; a diagnosis by default."""

    against: Annotated[Path | None, Option(help="Only compare with this second capture of it.")] = None
    bag: Annotated[
        list[Path] | None,
        Option(
            help="Compare with a rosbag2 folder or MCAP of the ROS side; without a capture: several bags "
            "with the first."
        ),
    ] = None
    predict: Annotated[bool, Option("--predict", help="Only say how much each route can carry.")] = False
    prove: Annotated[bool, Option("--prove", help="Emulate cFS and the advice; -o FILE.svg draws it.")] = (
        False
    )
    max_loss: Annotated[float | None, Option(parser=share, help="Exit code 3 beyond it, e.g. 1%.")] = None
    strict: Annotated[bool, Option("--strict", help="Exit code 3 also for what may be lost.")] = False
    list_lost: Annotated[Listing | None, Option(help="Only list the messages that were lost.")] = None
    output: Annotated[Path | None, Option("--output", "-o", hidden=True)] = None
    force: Annotated[bool, Option("--force", hidden=True)] = False


@grouped
def doctor(
    *,
    inputs: InputOptions,
    task: TaskOptions,
    duration: options.Duration = None,
    jobs: options.Jobs = None,
    printing: options.PrintOptions,
    verbose: Annotated[
        bool, Option("--verbose", "-v", help=f"{options.VERBOSE} All evidence, every hop and route.")
    ] = False,
    part: options.ScopeOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Find what was lost or is wrong, where and why.

    It prints one screen, one line with -q, all with -v. With -i it shows a table of verdicts that is updated
    live. Exit code 3: a loss or an error was found.
    """
    settings, scope = decoding.settings(constants=True), part.scope()
    _check_task(task, inputs, duration, decoding.constants)
    if task.output is not None and not task.prove:
        write = doors.part("report")
        write(inputs.files, task.output, force=task.force, printing=printing, part=part, decoding=decoding)
    elif task.predict:
        _predict(settings, scope, json=printing.json)
    elif task.prove:
        if not inputs.paths:
            raise ConfigError("--prove reads the capture several times: name files")
        doors.part("prove")(inputs, settings, printing, task)
    elif task.list_lost is not None:
        _list_lost(settings, scope, inputs, task.list_lost, printing, jobs or 0)
    elif task.bag:
        doors.part("bags")(settings, scope, inputs, task.bag, printing, verbose=verbose)
    elif task.against is not None:
        doors.part("against")(settings, scope, inputs.paths, task.against, printing)
    else:
        diagnosis = _examine(settings, scope, inputs, duration or 0, printing, jobs or 0, verbose=verbose)
        reasons = [] if task.max_loss is None else diagnosis.beyond(task.max_loss, strict=task.strict)
        bad = diagnosis.bad or (task.strict and diagnosis.uncertain)
        end(*reasons, lost=reasons or (task.max_loss is None and bad))


def _check_task(task: TaskOptions, inputs: InputOptions, duration: int | None, constants: list[str]) -> None:
    """Refuse options that have no effect together.

    Raises:
        ConfigError: there are such options.
    """
    options.check_duration(duration, inputs.paths)
    tasks: dict[str, object] = {"--predict": task.predict, "--list-lost": task.list_lost}
    tasks |= {"--against": task.against, "--bag": task.bag, "--prove": task.prove}
    choices = [name for name, argument in tasks.items() if argument]
    if len(choices) > 1:
        raise ConfigError(f"{' and '.join(choices)} exclude each other; choose one")
    for name, value in {"--max-loss": task.max_loss is not None, "--strict": task.strict}.items():
        if choices and value:
            raise ConfigError(
                f"{name} belongs to a diagnosis and has no effect with {choices[0]}: leave one out"
            )
    if choices and (duration or any(inputs.live)):
        raise ConfigError(f"{choices[0]} has no effect on live traffic: name files")
    if task.predict and inputs.paths:
        raise ConfigError("--predict does not read a capture: leave the files out")
    if constants and (task.against or task.bag):
        raise ConfigError(f"--set has no effect with {choices[0]}: leave one out")


def _examine(
    settings: Settings,
    scope: Scope,
    inputs: InputOptions,
    duration_ns: int,
    printing: options.PrintOptions,
    jobs: int,
    *,
    verbose: bool,
) -> Diagnosis:
    from edoras_tools.pipelines.doctor import Pace, examine
    from edoras_tools.render.doctor import LiveVerdicts

    json, quiet = printing
    if not (inputs.paths or any(inputs.live)):
        raise ConfigError("name the input to examine: FILE..., -i IFACE, or --listen PORT")
    live = not inputs.paths
    if live and scope.period:
        raise ConfigError("--start and --end select part of a file; for live traffic use --duration")
    with file_progress(inputs.paths, quiet=quiet or json or live) as bar:
        source, bench = open_input(inputs, settings, aligned=True, progress=bar)
        with LiveVerdicts(source.info.name, quiet=quiet) if live else nullcontext() as onlooker:
            pace = Pace(monotonic_ns, _EVERY_NS if live else 0, duration_ns, onlooker, jobs)
            findings = examine(source, bench, scope=scope, pace=pace, progress=bar)
    if json:
        print_json(findings.summary())
    elif live or source.statistics.datagrams:
        print_diagnosis(findings.diagnosis, source.info.name, quiet=quiet, verbose=verbose)
    end(*bench.mission.warnings, *findings.warnings, failure=findings.failure)
    if not live:
        no_datagrams(source)
    return findings.diagnosis


def print_diagnosis(result: Diagnosis, name: str, *, quiet: bool, verbose: bool) -> None:
    """Print a line, a screen, or all."""
    from edoras_tools.diagnosis.summary import summarize
    from edoras_tools.render.doctor import diagnosis, screen

    words = sys.argv[2:]
    again = "" if not {"-", "-i", "--listen"}.isdisjoint(words) else shlex.join(words)
    if quiet:
        sys.stdout.write(f"{summarize(result).headline}\n")
    elif verbose:
        print_view(lambda width: diagnosis(result, name, width))
    else:
        print_view(lambda width: screen(result, width, again), is_whole=True)


def _list_lost(
    settings: Settings,
    scope: Scope,
    inputs: InputOptions,
    listing: Listing,
    printing: options.PrintOptions,
    jobs: int,
) -> None:
    from edoras_tools.diagnosis.examination import Examination
    from edoras_tools.pipelines.doctor import Pace, examine, list_missing

    files = inputs.paths
    if not files or any(str(item) == "-" for item in files):
        raise ConfigError("--list-lost reads the capture twice, so it needs files, not stdin: name files")
    with file_progress(files, quiet=printing.quiet) as bar:
        source, bench = open_input(inputs, settings, aligned=True, progress=bar)
        pace = Pace(monotonic_ns, jobs=jobs)
        examination = Examination(bench.columns.context)
        examination.listing = True
        findings = examine(source, bench, scope=scope, pace=pace, progress=bar, examination=examination)
        again, _ = open_input(inputs, settings, aligned=True, progress=bar)
        losses = list_missing(findings.diagnosis, again, bench, bar)
    if listing is Listing.TABLE:
        from edoras_tools.render.doctor import missing_table

        print_view(lambda width: missing_table(losses, findings.diagnosis.zero_ns, width))
    elif listing is Listing.JSON:
        print_json(
            {"lost": sum(item.count for item in losses), "missing": [item.as_json() for item in losses]}
        )
    else:
        print_csv([item.as_json() for item in losses])
    end(*findings.warnings, failure=findings.failure, lost=findings.diagnosis.bad)


def _predict(settings: Settings, scope: Scope, *, json: bool) -> None:
    from edoras_tools.diagnosis.accounting.budget import predict

    bench = settings.workbench()
    if not bench.mission.routes:
        raise ConfigError("--predict needs a mission: name its files with -c")
    if scope.selection.where or scope.period:
        raise ConfigError(
            "--predict does not read a capture: --where, --start and --end cannot be used with it"
        )
    choice = scope.selection.over(bench)
    profile, headers = bench.mission.software.profile, bench.columns.context.headers
    budgets = [
        item
        for item in predict(bench.mission, bench.types, profile, headers)
        if choice.about(item.route.link.label, item.route.msg_id, bench.mission)
    ]
    if json:
        print_json({"routes": [item.as_json() for item in budgets]})
        return
    from edoras_tools.render.doctor import budgets as view

    print_view(lambda width: view(budgets, width))
