"""How a command that passes traffic on runs and ends: proxy, bridges, demos."""

from __future__ import annotations

from contextlib import AbstractContextManager, ExitStack
from typing import TYPE_CHECKING, Any, Protocol

import typer

from edoras_tools.cli.endings import LOST, lost_outputs, say, tell
from edoras_tools.cli.output import print_json
from edoras_tools.errors import EdorasError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from pathlib import Path

    from rich.console import Console, Group

    from edoras_tools.cli.options import PrintOptions
    from edoras_tools.pipelines.bridge.run import Bridges
    from edoras_tools.pipelines.proxy.run import Proxy


class Relay(Protocol):
    """What passes traffic on until it is stopped."""

    @property
    def run(self) -> Callable[..., None]:
        """Pass traffic on for ``duration_ns``; 0: until ``stop``."""
        ...

    def stop(self) -> None:
        """Let ``run`` end; may be called from a signal handler."""

    def close(self) -> None:
        """Close sockets and outputs."""


def run_relay(
    relay: Relay,
    begin: Callable[[], None],
    duration_ns: int | None,
    table: Callable[[Console], AbstractContextManager[Any]] | None = None,
    *,
    keyboard: bool = False,
) -> EdorasError | None:
    """Pass traffic on until the end, and close the relay; return the error that ended it early, or None.

    Args:
        begin: says what runs.
        duration_ns: how long; None or 0: until Ctrl-C.
        table: makes the table that shows it; None shows none.
        keyboard: whether keys switch faults while the table is shown.
    """
    from edoras_tools.pipelines.interrupt import on_interrupt

    with ExitStack() as stack:
        stack.enter_context(on_interrupt(relay.stop))  # before the user reads that Ctrl-C ends it
        how: dict[str, Any] = {}
        try:
            begin()
            if table is not None:
                from edoras_tools.render.terminal.terminal import error_console

                if keyboard:
                    from edoras_tools.pipelines.interrupt import Keys

                    how["keys"] = stack.enter_context(Keys())
                how["watcher"] = stack.enter_context(table(error_console()))
            relay.run(duration_ns=duration_ns or 0, **how)
        except EdorasError as error:
            return error
        finally:
            relay.close()
    return None


def finish_relay(
    relay: Bridges | Proxy,
    show: Callable[[Mapping[str, Any], int, Path | None], Group],
    notes: Callable[[Mapping[str, Any]], Iterable[str]],
    output: Path | None,
    printing: PrintOptions,
    failure: EdorasError | None,
) -> None:
    """End a command that passed traffic on: print its summary, as JSON or for people.

    Raises:
        EdorasError: it ended early.
        typer.Exit: with code 3, if anything was lost.
    """
    from edoras_tools.render.bridge import served
    from edoras_tools.render.terminal.terminal import error_console
    from edoras_tools.render.terminal.text import clean

    summary, recorder, (json, quiet) = relay.summary(), relay.recorder, printing
    shown = recorder.recorded.display if recorder else None
    if json:
        print_json({**summary, "foxglove": shown})
    elif not quiet:
        console = error_console()
        console.print(show(summary, console.width, output))
        for line in served(shown) if shown else ():
            say(line)
    if json or quiet:
        for line in notes(summary):
            tell(clean(line))  # it may contain text that a peer sent
    if failure is None and recorder is not None:
        failure = recorder.failure
    if failure is not None:
        raise failure
    lost_outputs(recorder.recorded.losses if recorder else ())
    if summary["lost"]:
        raise typer.Exit(LOST)
