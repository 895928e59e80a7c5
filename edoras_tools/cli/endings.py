"""The last output of a command, and its exit code."""

from __future__ import annotations

import sys
from contextlib import suppress
from typing import TYPE_CHECKING

import typer

from edoras_tools.errors import CaptureError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.decode import Context
    from edoras_tools.io import Source
    from edoras_tools.io.formats.watched import OutputLoss
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.capture.record import CaptureReport
    from edoras_tools.pipelines.export.sources import TopicSource

LOST = 3
"""Exit code: finished, but data was lost or found lost."""
INTERRUPTED = 130
"""Exit code of a command that Ctrl-C, SIGTERM or SIGHUP ended before its work was done, as in shells."""


def no_datagrams(source: Source) -> None:
    """Raise an error if a file contained no UDP datagram.

    Raises:
        CaptureError: the file contained none.
    """
    statistics = source.statistics
    if not statistics.datagrams:
        content = f"{statistics.skipped:,} frames of other kinds" if statistics.skipped else "it is empty"
        raise CaptureError(f"{source.info.name}: no UDP datagram in it ({content}); nothing to decode")


def nothing_shown(source: Source, count: int, context: Context, *, live: bool, every: bool) -> None:
    """Print why a list is empty, notes from decoding, and the capture's losses.

    Args:
        count: number of packets shown.
        live: whether the source has no end.
        every: whether datagrams of no link were shown too.

    Raises:
        CaptureError: a file contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    if not count and not live:
        no_datagrams(source)
    tell(*context.notes)
    if not count:
        _none_chosen(source, "" if every else "; -a shows every link")
    lost(source)
    if context.unnamed and not every:
        raise typer.Exit(LOST)


def _none_chosen(source: Source, hint: str = "") -> None:
    if total := source.statistics.datagrams:
        tell(f"none of the {total:,} datagrams was selected{hint}")


def lost(source: Source) -> None:
    """End with exit code 3 if the capture itself lost packets.

    Raises:
        typer.Exit: with code 3, if it did.
    """
    statistics = source.statistics
    lines = statistics.warnings
    if statistics.outages:
        from edoras_tools.render.capture.host import outage_lines

        lines = [*lines, *outage_lines(statistics.outages)]
    tell(*lines)
    if drops := statistics.kernel_drops:
        tell(f"the capture itself lost {drops:,} packets; it was too slow for them")
        raise typer.Exit(LOST)


def say(*lines: str) -> None:
    """Print lines on standard error, without the program's name."""
    sys.stderr.writelines(f"{line}\n" for line in lines)
    sys.stderr.flush()


def tell(*lines: str) -> None:
    """Print lines on standard error while a command runs."""
    say(*(f"edoras: {line}" for line in lines))


def tell_reach(endpoint: Endpoint, may: str, **words: str) -> None:
    """Print before any traffic who may send to a port, except on loopback. See ``reach_note``."""
    from edoras_tools.io.net.address import reach_note

    if note := reach_note(endpoint, may, **words):
        tell(note)


def lost_outputs(losses: Sequence[OutputLoss]) -> None:
    """Report outputs that were removed while they were written.

    Raises:
        typer.Exit: with code 3, if there are any.
    """
    tell(*map(str, losses))
    if losses:
        raise typer.Exit(LOST)


def topics_read(source: TopicSource) -> None:
    """End a command that read the topics of an input.

    Raises:
        EdorasError: the input ended early, or contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    tell(*source.notes)
    if source.left_out:
        tell(f"{source.left_out:,} messages are incomplete and were left out")
    if source.failure is not None:
        raise source.failure
    if source.source is not None:
        no_datagrams(source.source)
        lost(source.source)
    if source.unnamed:
        raise typer.Exit(LOST)


def no_messages(source: Source, count: int) -> None:
    """Print that no message was selected.

    Raises:
        CaptureError: the recording has no message.
    """
    total = source.statistics.datagrams
    if not total:
        raise CaptureError(f"{source.info.name}: no message in it")
    if not count:
        tell(f"none of the {total:,} messages was selected")


def finish(report: CaptureReport, *, live: bool) -> None:
    """End a command that read a whole source.

    Raises:
        EdorasError: the source ended early, or contained no UDP at all.
        typer.Exit: with code 3, if the capture lost packets, or traffic of a link was left out.
    """
    ledger = report.ledger
    tell(*ledger.unfit(), *ledger.mission.warnings, *report.notes, *ledger.unread)
    if report.failure is not None:
        raise report.failure
    if ledger.mission.recorded:
        no_messages(report.source, ledger.datagrams)
    elif not live:
        no_datagrams(report.source)
        if not ledger.datagrams:
            _none_chosen(report.source)
    if report.losses:
        with suppress(typer.Exit):
            lost(report.source)
        lost_outputs(report.losses)
    lost(report.source)
    if report.unnamed:
        raise typer.Exit(LOST)
