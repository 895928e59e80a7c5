"""What a command says, and tells the shell, at its end."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import typer

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from edoras_tools.pipelines.record import Report
    from edoras_tools.sources import Source

LOST = 3
"""Exit code: finished, but data was lost or found lost."""


def no_datagrams(source: Source) -> None:
    """Fail when a file held no UDP at all.

    Raises:
        CaptureError: it did not.
    """
    statistics = source.statistics
    if not statistics.datagrams:
        what = f"{statistics.skipped:,} frames of other kinds" if statistics.skipped else "it is empty"
        raise CaptureError(f"{source.info.name}: no UDP datagram in it ({what}); nothing to decode")


def nothing_shown(source: Source, shown: int, *, live: bool) -> None:
    """Say why a list stayed empty, and what was lost.

    Raises:
        CaptureError: a file held no UDP at all.
    """
    if not shown and not live:
        no_datagrams(source)
    if not shown:
        _none_chosen(source, "; -a shows every link")
    lost(source)


def _none_chosen(source: Source, hint: str = "") -> None:
    there = source.statistics.datagrams
    if there:
        sys.stderr.write(f"edoras: none of the {there:,} datagrams was chosen{hint}\n")


def lost(source: Source) -> None:
    """Tell the shell that the capture itself lost packets.

    Raises:
        typer.Exit: with code 3, when it did.
    """
    for warning in source.statistics.warnings:
        sys.stderr.write(f"edoras: {warning}\n")
    drops = source.statistics.kernel_drops
    if drops:
        sys.stderr.write(f"edoras: the capture itself lost {drops:,} packets; it was too slow for them\n")
        raise typer.Exit(LOST)


def finish(report: Report, *, live: bool) -> None:
    """End a command that read a whole source.

    Raises:
        EdorasError: the source ended early, or held no UDP at all.
        typer.Exit: with code 3, when the capture lost packets.
    """
    for warning in report.ledger.mission.warnings:
        sys.stderr.write(f"edoras: {warning}\n")
    if report.failure is not None:
        raise report.failure
    if report.interrupted and not live:
        sys.stderr.write(f"edoras: interrupted after {report.ledger.datagrams:,} datagrams\n")
    elif not live:
        no_datagrams(report.source)
        if not report.ledger.datagrams:
            _none_chosen(report.source)
    lost(report.source)
