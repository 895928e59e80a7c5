"""``edoras check``: is a capture as it should be? ``edoras compare``: are later runs worse than earlier?

``edoras doctor --against`` and ``--bag``: a capture compared with another one, or with ROS bags.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import Argument, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.options import grouped, share
from edoras_tools.cli.output import end, file_progress, no_datagrams, print_json, print_view, tell
from edoras_tools.errors import CaptureError, ConfigError, InterruptError

if TYPE_CHECKING:
    from edoras_tools.addons.runs.check import CheckReport, Examined
    from edoras_tools.addons.runs.comparison import BagComparison
    from edoras_tools.addons.runs.differences import DifferenceLimits
    from edoras_tools.addons.runs.expectations import Expectations
    from edoras_tools.addons.runs.run import Run
    from edoras_tools.diagnosis.balance import Chain
    from edoras_tools.io import Source
    from edoras_tools.pipelines.doctor import Scope
    from edoras_tools.pipelines.workbench import Settings


class CheckOptions(NamedTuple):
    """Use of the expectations."""

    init: Annotated[bool, Option("--init", help="Draft expectations from good runs, each a file.")] = False
    update: Annotated[bool, Option("--update", help="Widen them by this run, which is a good one.")] = False
    output: Annotated[Path | None, Option("--output", "-o", help="With --init: write the draft here.")] = None
    force: recordings.Force = False
    junit: Annotated[Path | None, Option(help="Also write the results as JUnit XML.")] = None


@grouped
def check(
    *,
    inputs: InputOptions,
    task: CheckOptions,
    duration: options.Duration = None,
    part: options.ScopeOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Check a capture against expectations, or draft them.

    edoras check FILE... EXPECT.yaml checks; edoras check --init RUN... drafts, from each file a run.

    Expectations are bounds of rates, counts, sizes, losses and latencies, what must hold of fields, and which
    events, findings and verdicts may appear. Exit code 3: one of them is not met.
    """
    from edoras_tools.addons.runs.check import check as run
    from edoras_tools.addons.runs.check import write_junit
    from edoras_tools.addons.runs.expectations import load_expectations
    from edoras_tools.addons.runs.run import Run
    from edoras_tools.io.outputs import check_new
    from edoras_tools.pipelines.doctor import Pace

    scope = part.scope()
    if task.init:
        _draft(inputs, task, scope, printing, decoding)
        return
    if task.update and (task.junit or printing.json or any(inputs.live)):
        raise ConfigError(
            "--update changes the expectations by a recording: leave --junit, --json and -i out"
        )
    if task.output or (task.force and task.junit is None):
        raise ConfigError(
            "--output is an option of --init, --force of --init and --junit, which writes results to a file"
        )
    inputs, path = _expectations(inputs)
    live = not inputs.paths
    if live and scope.period:
        raise ConfigError("--start and --end select part of a file; for live traffic use --duration")
    options.check_duration(duration, inputs.paths)
    if task.junit is not None:
        check_new(task.junit, [*inputs.paths, path], force=task.force)
    expected, (json, quiet) = load_expectations(path), printing
    with file_progress(inputs.paths, quiet=quiet or json or live) as bar:
        settings = decoding.settings(constants=True)
        opened = partial(open_input, inputs, settings, aligned=True, messages=True, progress=bar)
        source, bench = opened()
        pace = Pace(monotonic_ns, 0, duration or 0)
        report = run(source, bench, expected, scope=scope, pace=pace, progress=bar)
        _check_whole(report.findings)
        if task.update:
            _update(path, expected, report, Run.read(*opened(), scope=scope, progress=bar))
            return
    if task.junit is not None:
        write_junit(task.junit, report.results, ("check", report.file, report.source), report.seconds)
    if json:
        print_json(report.as_json())
    elif not quiet or report.failed:
        from edoras_tools.addons.runs.views import check_view

        print_view(lambda width: check_view(report.as_json(), width))
    _end(source, report.findings, live=live)
    end(lost=report.failed)


def _expectations(inputs: InputOptions) -> tuple[InputOptions, Path]:
    """Return the inputs, and the file of expectations, which is the last argument."""
    files, read = inputs.files
    form = "edoras check FILE... EXPECT.yaml; --init FILE drafts the expectations from a good recording"
    if not files:
        raise ConfigError(f"name the expectations last: {form}")
    if len(files) == 1 and not read and not any(inputs.live):
        raise ConfigError(f"{files[0]}: two files are needed: {form}")
    return inputs._replace(files=FileOptions(files[:-1], read)), files[-1]


def _draft(
    inputs: InputOptions,
    task: CheckOptions,
    scope: Scope,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    from edoras_tools.addons.runs.draft import Draft
    from edoras_tools.addons.runs.run import Run, run_paths

    if task.junit or printing.json:
        raise ConfigError("--init only drafts expectations: --junit and --json cannot be used with it")
    if any(inputs.live) or not inputs.paths:
        raise ConfigError("--init drafts from a recording: edoras check --init FILE...")
    path = recordings.text_output(task.output, inputs.paths, force=task.force)
    with file_progress(inputs.paths, quiet=printing.quiet) as bar:
        runs, settings = [], decoding.settings(constants=True)
        for item in run_paths(inputs.paths):
            one = inputs._replace(files=FileOptions([item], None))
            source, bench = open_input(one, settings, messages=True, progress=bar)
            runs.append(Run.read(source, bench, scope=scope, progress=bar))
            _check_whole(runs[-1].findings)
            _end(source, runs[-1].findings, live=False)
    draft = Draft(runs)
    recordings.put_text(draft.text, path)
    if not printing.quiet:
        tell(*draft.notes)
    unexamined = [str(item) for run in runs for item in run.findings.unnamed]
    end(*dict.fromkeys(unexamined), lost=unexamined)


def _update(path: Path, expected: Expectations, report: CheckReport, run: Run) -> None:
    """Widen the expectations so that a run meets them."""
    from edoras_tools.addons.runs.draft import ExpectationUpdate

    update = ExpectationUpdate(path.read_text(encoding="utf-8"), expected, report, run)
    if update.notes:
        recordings.write_page(update.text, path)
    tell(*(update.notes or ["this run meets all expectations: nothing was widened"]))


def _check_whole(findings: Examined) -> None:
    """Refuse to judge a part of a file."""
    if isinstance(findings.failure, InterruptError):
        raise findings.failure


def _end(source: Source, findings: Examined, *, live: bool) -> None:
    end(*findings.warnings, failure=findings.failure)
    if not live:
        no_datagrams(source)


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
    end(lost=report["worse"])


def against(
    settings: Settings, scope: Scope, files: list[Path], other: Path, printing: options.PrintOptions
) -> None:
    """Compare captures with another one of the same traffic."""
    from edoras_tools.addons.runs.comparison import diff
    from edoras_tools.addons.runs.views import comparison_table
    from edoras_tools.pipelines.workbench import open_files

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
    end(lost=comparison.lost)


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
    from edoras_tools.addons.runs.comparison import against_bag, against_capture, bridge_counts
    from edoras_tools.cli.doctor import print_diagnosis
    from edoras_tools.diagnosis.balance import chains
    from edoras_tools.pipelines.doctor import Pace, examine

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
    end(*(judged.warnings if judged else ()), lost=lost or (judged and judged.diagnosis.bad))


def _print_bags(comparisons: list[BagComparison], ways: list[Chain], first: str) -> None:
    from edoras_tools.addons.runs.views import comparison_table
    from edoras_tools.render.doctor import chain_table

    for item in comparisons:
        print_view(f"first: {first}, second: {item.bag}")
        print_view(partial(comparison_table, item.comparison))
        if item.left_out:
            tell(f"{item.bag}: {item.left_out:,} messages do not fit their type and are not compared")
    if ways:
        print_view(lambda width: chain_table(ways, width))
