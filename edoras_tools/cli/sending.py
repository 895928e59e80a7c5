"""Options of the commands that send, how their words become orders, and how such a command ends."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.model import Endpoint
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.transmission import Transmission
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults import FaultPlan
    from edoras_tools.wire.sbn import Peer

_TIMEOUT_NS = 10_000_000_000


def endpoint(text: str) -> Endpoint:
    """Read ``HOST:PORT``."""
    from edoras_tools.errors import EdorasError
    from edoras_tools.sources.udp import parse_endpoint

    try:
        return parse_endpoint(text)
    except EdorasError as error:
        raise typer.BadParameter(str(error)) from None


def peer(text: str) -> Peer:
    """Read ``SC:CPU``, decimal or hex."""
    from edoras_tools.wire.sbn import Peer

    spacecraft, _, processor = text.partition(":")
    try:
        found = Peer(int(spacecraft, 0), int(processor, 0))
    except ValueError:
        found = Peer(-1, -1)
    if not all(0 <= number < 1 << 32 for number in found):
        raise typer.BadParameter(f"{text!r} is no SC:CPU; write 66:3 or 0x42:3")
    return found


def rate(text: str) -> tuple[str, float]:
    """Read ``HZ`` or ``ROUTE=HZ``."""
    pattern, _, number = text.rpartition("=")
    try:
        value = float(number)
    except ValueError:
        value = 0
    if not 0 < value < float("inf"):
        raise typer.BadParameter(f"{text!r} is no rate; write 30, or ROUTE=30, in messages a second")
    return pattern or "*", value


def positive(text: str) -> float:
    """Read a number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0
    if not 0 < value < float("inf"):
        raise typer.BadParameter(f"{text!r} is not a number above 0")
    return value


def loops(text: str) -> int:
    """Read a number of passes: 1 or more, or 0 for no end."""
    value = options.number(text)
    if value < 0:
        raise typer.BadParameter(f"{text} is not 0 (for no end) or more")
    return value


_option = partial(typer.Option, rich_help_panel="Sending")

Target = Annotated[
    Any,
    _option(
        "--target", metavar="HOST:PORT", parser=endpoint, help="Where to; this machine unless it is named."
    ),
]
As = Annotated[
    Any,
    _option("--as", metavar="SC:CPU", parser=peer, help="SBN: send under this identity, as 66:3."),
]
RoleName = Annotated[
    str,
    _option(
        "--role",
        metavar="ROLE",
        help="SBN: behave as a stock peer, as the bridge, or as captured: nothing but what it sent.",
    ),
]
Ear = Annotated[
    Any,
    _option(
        "--listen",
        metavar="[HOST:]PORT",
        parser=endpoint,
        help="Where answers come in; SBN: send from there.",
    ),
]
NoListen = Annotated[bool, _option("--no-listen", help="Leave the telemetry port to others.")]
WaitFor = Annotated[
    list[str] | None,
    _option(
        metavar="GATE",
        help="First wait for peer, to-enabled (asks for it) or event:TEXT; or for nothing; repeatable.",
    ),
]
Timeout = Annotated[
    int | None,
    _option(metavar="TIME", parser=options.duration, help="How long to wait for gates; 10s."),
]
Linger = Annotated[
    int | None,
    _option(metavar="TIME", parser=options.duration, help="Listen so long after the last datagram."),
]
Allow = Annotated[
    list[str] | None,
    _option(metavar="ROUTE", help="Send nothing but these, as 0x1827 or '0x18*'; repeatable."),
]
MaxRate = Annotated[
    float | None,
    _option(metavar="HZ", parser=positive, help="Never faster; 1000 to other machines."),
]
Unlimited = Annotated[bool, _option("--unlimited", help="Lift the cap on the rate.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Send to another machine without asking.")]
Sequence = Annotated[str, _option(metavar="RULE", help="Sequence counts: keep, count or zero.")]
Checksum = Annotated[str, _option(metavar="RULE", help="Checksums: keep, fix, zero or wrong.")]
Step = Annotated[bool, _option("--step", help="One by one: n sends the next, space runs, q ends.")]
Output = Annotated[
    Path | None,
    typer.Option(
        "--output",
        "-o",
        metavar="FILE",
        help="Record what is sent and what comes back, to .mcap, .pcapng or .pcap; faults into .mcap.",
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be sent, and send nothing.")]


def sending(
    target: Target = None,
    sender: As = None,
    role: RoleName = "stock",
    listen: Ear = None,
    no_listen: NoListen = False,
    wait_for: WaitFor = None,
    timeout: Timeout = None,
    linger: Linger = None,
    allow: Allow = None,
    max_rate: MaxRate = None,
    unlimited: Unlimited = False,
    yes: Yes = False,
    sequence: Sequence = "keep",
    checksum: Checksum = "keep",
    step: Step = False,
) -> Orders:
    """Gather the options that say how to send."""
    from edoras_tools.pipelines.orders import Orders, Role
    from edoras_tools.sessions.outgoing import ChecksumRule, SequenceRule

    return Orders(
        target=target,
        sender=sender,
        role=one_of(Role, role, "--role"),
        listen=listen,
        deaf=no_listen,
        wait_for=tuple(wait_for or ()),
        timeout_ns=timeout or _TIMEOUT_NS,
        linger_ns=linger,
        allow=tuple(allow or ()),
        max_rate_hz=max_rate or 0.0,
        unlimited=unlimited,
        yes=yes,
        sequence=one_of(SequenceRule, sequence, "--sequence"),
        checksum=one_of(ChecksumRule, checksum, "--checksum"),
        step=step,
    )


def one_of(kind: Any, text: str, option: str) -> Any:
    """Read a word of an enumeration."""
    try:
        return kind(text.lower())
    except ValueError:
        raise typer.BadParameter(f"{option}: {text!r} is none of {', '.join(kind)}") from None


takes_sending = options.gathered("orders", sending)


def carry_out(
    transmission: Transmission,
    bench: Workbench,
    faults: FaultPlan,
    *,
    inputs: tuple[Path, ...] = (),
    output: Path | None,
    dry_run: bool,
    json: bool,
    quiet: bool,
) -> None:
    """Send, or say what would be sent; tell people or programs what came of it.

    Args:
        transmission: what.
        bench: compiles the filters of faults.
        faults: what goes wrong on purpose.
        inputs: files that are read, and not to be overwritten.
        output: where to record what crosses the wire.
        dry_run: send nothing.
        json: print JSON.
        quiet: print nothing else.

    Raises:
        EdorasError: it could not be sent.
        typer.Exit: with code 3, when something sent was surely lost.
    """
    from edoras_tools.cli.endings import LOST
    from edoras_tools.cli.output import print_json
    from edoras_tools.pipelines.fault_where import compiler
    from edoras_tools.pipelines.safety import check_target
    from edoras_tools.render import replay as view
    from edoras_tools.render.console import error_console, output_console

    orders = transmission.orders
    machine = faults.start(where=compiler(bench)) if faults else None
    if dry_run:
        plan = {**transmission.plan(), "faults": [str(rule) for rule in faults.rules]}
        if json:
            print_json(plan)
        else:
            output_console().print(view.plan(plan))
        return
    assert orders.target is not None
    asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    check_target(orders.target, yes=orders.yes, confirm=_confirm if asks else None)
    tape = None
    if output is not None:
        from edoras_tools.pipelines.record import Target as Goal
        from edoras_tools.pipelines.record import check_target as check_output
        from edoras_tools.pipelines.tape import Tape

        goal = Goal(output)
        check_output(goal, inputs)
        tape = partial(Tape, target=goal, bench=bench)
    keys = None
    if orders.step or asks:
        from edoras_tools.pipelines.keys import Keys

        keys = Keys()
    with view.watching(transmission.total, quiet=quiet, keys=keys is not None) as watcher:
        report = transmission.run(faults=machine, keys=keys, watcher=watcher, tape=tape)
    summary = report.summary()
    if json:
        print_json(summary)
    elif not quiet:
        error_console().print(view.outcome(summary, str(orders.target)))
    if report.failure is not None:
        raise report.failure
    if report.send_errors or report.seen.lost:
        raise typer.Exit(LOST)


def _confirm(question: str) -> bool:
    return typer.confirm(question, err=True)
