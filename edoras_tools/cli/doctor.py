"""``edoras doctor``: what is wrong on a link, where and why."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.profile import SimProfile

_EVERY_NS = 1_000_000_000


@options.takes_decoding
def doctor(
    settings: Settings,
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE]...", help="pcap, pcapng or MCAP; - is stdin; several are merged."),
    ] = None,
    interface: options.Interface = None,
    listen: options.Listen = None,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against", metavar="FILE", help="Only tell how this capture of the same traffic differs."
        ),
    ] = None,
    predict: Annotated[
        bool, typer.Option("--predict", help="Only tell what each route of the mission can carry.")
    ] = False,
    constant: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="NAME=VALUE", help="A constant of your cFS, as app_msg_limit=8; repeatable."
        ),
    ] = None,
    duration: options.Duration = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Say what is wrong on this link, where and why: loss per hop, its evidence, and what to change.

    Live (-i) a table of verdicts is kept current. Exit code 3 tells that loss was found.
    """
    from edoras_tools.pipelines.doctor import profile_with

    profile = profile_with(constant or ())
    if predict:
        _predict(settings, profile, json=json)
    elif against is not None:
        _compare(settings, files or [], against, json=json)
    else:
        _examine(settings, profile, files, interface, listen, duration or 0, json=json, quiet=quiet)


def _examine(
    settings: Settings,
    profile: SimProfile,
    files: list[Path] | None,
    interface: str | None,
    listen: list[str] | None,
    duration: int,
    *,
    json: bool,
    quiet: bool,
) -> None:
    from contextlib import nullcontext
    from time import monotonic_ns

    from edoras_tools.cli.endings import LOST, no_datagrams
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines.doctor import examine
    from edoras_tools.render.doctor_live import LiveVerdicts

    if not (files or interface or listen):
        raise ConfigError("name what to examine: FILE..., -i IFACE, or --listen PORT")
    source, bench = open_input(files, interface, listen, settings)
    live = not files
    with LiveVerdicts(source.info.name, quiet=quiet) if live else nullcontext() as onlooker:
        findings = examine(
            source,
            bench,
            profile=profile,
            clock=monotonic_ns,
            every_ns=_EVERY_NS if live else 0,
            duration_ns=duration,
            onlooker=onlooker,
        )
    if json:
        from edoras_tools.cli.output import print_json

        print_json(findings.summary())
    elif findings.diagnosis.datagrams:
        from edoras_tools.render.console import output_console
        from edoras_tools.render.doctor import diagnosis

        console = output_console()
        console.print(diagnosis(findings.diagnosis, source.info.name, console.width))
    for warning in (*bench.mission.warnings, *source.statistics.warnings):
        sys.stderr.write(f"edoras: {warning}\n")
    if findings.failure is not None:
        raise findings.failure
    if not live:
        no_datagrams(source)
    if findings.diagnosis.lost or findings.diagnosis.capture.drops:
        raise typer.Exit(LOST)


def _predict(settings: Settings, profile: SimProfile, *, json: bool) -> None:
    from edoras_tools.diagnosis.budget import predict
    from edoras_tools.errors import ConfigError

    bench = settings.workbench()
    if not bench.mission.routes:
        raise ConfigError("--predict needs a mission: name its files with -c")
    budgets = predict(bench.mission, bench.types, profile)
    if json:
        from edoras_tools.cli.output import print_json

        print_json({"routes": [item.as_json() for item in budgets]})
        return
    from edoras_tools.render.console import output_console
    from edoras_tools.render.doctor import budgets as view

    console = output_console()
    console.print(view(budgets, console.width))


def _compare(settings: Settings, files: list[Path], against: Path, *, json: bool) -> None:
    from edoras_tools.cli.endings import LOST
    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines.diff import diff
    from edoras_tools.pipelines.workbench import open_files

    if not files:
        raise ConfigError("--against needs two captures: edoras doctor FIRST --against SECOND")
    first = open_files(files)
    found = diff(first, open_files([against]), settings.workbench(first.info))
    if json:
        from edoras_tools.cli.output import print_json

        print_json(found.as_json())
    else:
        from edoras_tools.render.console import output_console
        from edoras_tools.render.doctor import comparison

        console = output_console()
        console.print(comparison(found, console.width))
    if found.lost:
        raise typer.Exit(LOST)
