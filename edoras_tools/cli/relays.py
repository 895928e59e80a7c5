"""How a command that passes traffic on runs and ends: proxy, bridges, demos."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, ExitStack, nullcontext
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple, Protocol

from typer import BadParameter, Option

from edoras_tools import doors
from edoras_tools.cli import recordings
from edoras_tools.cli.options import PrintOptions, headed
from edoras_tools.cli.output import Metrics, end, lost_outputs, measured, place, print_json, say, tell
from edoras_tools.errors import EdorasError

if TYPE_CHECKING:
    from pathlib import Path

    from rich.console import Console, Group

    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.recorder import RelayRecorder
    from edoras_tools.pipelines.workbench import Workbench


_SHORTEST_TOKEN: Final = 8


Origins = Annotated[
    list[str] | None,
    Option("--allow-origin", metavar="ORIGIN", help="Foxglove: also allow pages of this origin."),
]


def token(text: str) -> str:
    """Read a token; a short one could be guessed."""
    if len(text) < _SHORTEST_TOKEN:
        raise BadParameter(
            f"a token needs at least {_SHORTEST_TOKEN} characters; a shorter one is easy to guess"
        )
    return text


Token = Annotated[
    Any,
    Option(envvar="EDORAS_TOKEN", parser=token, help="Foxglove: clients need it: ws://HOST:PORT/?token=..."),
]


@headed("Outputs")
class RelayOutputOptions(NamedTuple):
    """Where a command that relays traffic also writes it: to a recording, and to Foxglove."""

    output: recordings.Output = None
    force: recordings.Force = False
    live: Annotated[Any, Option(parser=place, metavar="[HOST:]PORT", help="For Foxglove, e.g. 8765.")] = None
    allow_origin: Origins = None
    token: Token = None
    metrics: Metrics = None

    def recorder(
        self, workbench: Callable[[], Workbench], name: str, **how: Any
    ) -> Callable[[], RelayRecorder] | None:
        """Check the target; return a function that starts the recorder, None if nothing is recorded or shown.

        Args:
            workbench: returns the workbench for decoding.
            how: see ``RelayRecorder``.
        """
        if self.output is None and self.live is None:
            return None
        from edoras_tools.pipelines.recorder import RelayRecorder

        goal, bench = recordings.recording_target(self.output, force=self.force), workbench()
        show = None
        if self.live is not None:
            show = doors.part("display").server(bench, self.live, self.allow_origin, self.token)
        return lambda: RelayRecorder(goal, bench, name, show=show, **how)


class Relay(Protocol):
    """A program part that forwards traffic until it is stopped."""

    @property
    def run(self) -> Callable[..., None]:
        """Pass traffic on for ``duration_ns``; 0: until ``stop``."""

    def stop(self) -> None:
        """Let ``run`` end; may be called from a signal handler."""

    def close(self) -> None:
        """Close sockets and outputs."""


class SummedRelay(Protocol):
    """A relay that has ended, with its counts."""

    @property
    def recorder(self) -> RelayRecorder | None:
        """The recorder of its traffic."""

    def summary(self) -> dict[str, Any]:
        """Return the forwarded and the lost traffic, in the shape of JSON."""


def run_relay(
    relay: Relay,
    begin: Callable[[], None],
    duration_ns: int | None,
    table: Callable[[Console], AbstractContextManager[Any]] | None = None,
    *,
    keyboard: bool = False,
    metrics: Endpoint | None = None,
) -> EdorasError | None:
    """Forward traffic until the end, and close the relay; return the error that ended it early, or None.

    Args:
        begin: prints what runs.
        duration_ns: duration, ns; None or 0: until Ctrl-C.
        table: makes the live table; None: no table.
        keyboard: whether keys switch faults while the table is shown.
        metrics: address where the figures are served; None: they are not.
    """
    from edoras_tools.pipelines.reading import on_interrupt

    with ExitStack() as stack:
        stack.enter_context(on_interrupt(relay.stop))  # before the user reads that Ctrl-C ends it
        how: dict[str, Any] = {}
        try:
            begin()
            if table is not None:
                from edoras_tools.render.terminal.palette import error_console

                if keyboard:
                    from edoras_tools.pipelines.reading import Keys

                    how["keys"] = stack.enter_context(Keys())
                how["watcher"] = stack.enter_context(table(error_console()))
            if metrics:
                how["watcher"] = stack.enter_context(measured(nullcontext(how.get("watcher")), metrics))
            relay.run(duration_ns=duration_ns or 0, **how)
        except EdorasError as error:
            return error
        finally:
            relay.close()
    return None


def finish_relay(
    relay: SummedRelay,
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
    from edoras_tools.render.terminal.palette import error_console
    from edoras_tools.render.terminal.text import clean

    summary, recorder, (json, quiet) = relay.summary(), relay.recorder, printing
    display = recorder.recorded.display if recorder else None
    if json:
        print_json({**summary, "foxglove": display})
    elif not quiet:
        console = error_console()
        console.print(show(summary, console.width, output))
        if display:
            say(*doors.part("display").served(display))
    if json or quiet:
        for line in notes(summary):
            tell(clean(line))  # it may contain text that a peer sent
    if failure is None and recorder is not None:
        failure = recorder.failure
    end(failure=failure)
    lost_outputs(recorder.recorded.losses if recorder else ())
    end(lost=summary["lost"])
