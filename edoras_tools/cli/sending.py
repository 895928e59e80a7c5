"""Options of the commands that send, and how these commands end."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from typer import BadParameter, Exit, Option, confirm

from edoras_tools import doors
from edoras_tools.cli import options, recordings
from edoras_tools.cli.options import duration, headed, room, share
from edoras_tools.cli.output import (
    INTERRUPTED,
    address,
    end,
    lost_outputs,
    print_json,
    print_view,
    tell_reach,
)
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.model import Endpoint, Peer
    from edoras_tools.pipelines.capture.record import Target as RecordingTarget
    from edoras_tools.pipelines.sending.options import SendOptions
    from edoras_tools.pipelines.sending.run import Transmission
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.machine import FaultPlan

_TIMEOUT_NS = 10_000_000_000


def peer(text: str) -> Peer:
    """Read ``SC:CPU``, decimal or hex."""
    from edoras_tools.model import Peer

    spacecraft, _, processor = text.partition(":")
    try:
        identity = Peer(int(spacecraft, 0), int(processor, 0))
    except ValueError:
        identity = Peer(-1, -1)
    if not all(0 <= number < 1 << 32 for number in identity):
        raise BadParameter(f"{text!r} is not SC:CPU; write 66:3 or 0x42:3")
    return identity


def rate(text: str) -> tuple[str, float]:
    """Read ``HZ`` or ``ROUTE=HZ``."""
    pattern, _, number = text.rpartition("=")
    try:
        return pattern or "*", factor(number)
    except BadParameter:
        mistake = f"{text!r} is not a rate; write 30, or ROUTE=30, in messages per second"
        raise BadParameter(mistake) from None


def factor(text: str) -> float:
    """Read a number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0
    if not 0 < value < float("inf"):
        raise BadParameter(f"{text!r} is not a number above 0")
    return value


def limit(text: str) -> float:
    """Read a limit of a rate, Hz; 0 for none."""
    return 0.0 if text == "0" else factor(text)


def loops(text: str) -> int:
    """Read a number of passes: 1 or more, or 0 for no end."""
    value = options.number(text)
    if value < 0:
        raise BadParameter(f"{text} is less than 0; write 0 for no end")
    return value


Target = Annotated[Any, Option(parser=address, help="Where to send; default: this machine.")]
As = Annotated[Any, Option("--as", parser=peer, help="SBN: send as this peer, e.g. 66:3.")]
Listen = Annotated[
    Any,
    Option(parser=address, metavar="[HOST:]PORT", help="Where answers come; SBN: also where it sends from."),
]
Timeout = Annotated[int | None, Option(parser=duration, help="To wait for cFS and answers; default 10s.")]
Allow = Annotated[list[str] | None, Option(help="Send only these routes, e.g. 0x1827 or '0x18*'.")]
MaxRate = Annotated[
    float | None, Option(parser=limit, metavar="HZ", help="Default: none; to other machines 1000; 0: none.")
]
Yes = Annotated[bool, Option("--yes", "-y", help="Send to another machine without asking.")]
DryRun = Annotated[bool, Option("--dry-run", help="Print what would be sent; send nothing.")]


@headed("Sending")
class SendingOptions(NamedTuple):
    """How to send, and which faults to inject."""

    faults: options.FaultOptions
    target: Target = None
    sender: As = None
    role: Annotated[str, Option(help="SBN: behave as stock, bridge, or as captured.")] = "stock"
    listen: Listen = None
    no_listen: Annotated[bool, Option("--no-listen", help="Do not bind the telemetry port.")] = False
    wait_for: Annotated[list[str] | None, Option(help="At first: peer, to-enabled, event:TEXT, nothing.")] = (
        None
    )
    timeout: Timeout = None
    linger: Annotated[int | None, Option(parser=duration, help="Listen after the last; default 2s.")] = None
    expect: Annotated[
        list[str] | None,
        Option(
            help="Exit code 3 without it: event:TEXT, counter:TO_HK.command_counter[+N], topic or name, or "
            "the values of FILE, a good run."
        ),
    ] = None
    tolerance: Annotated[
        list[Any] | None, Option(parser=room, metavar="[FIELD=]VALUE", help="Of --expect FILE: percent.")
    ] = None
    expect_within: Annotated[int | None, Option(parser=duration, hidden=True)] = None
    max_loss: Annotated[float | None, Option(parser=share, help="Exit code 3 beyond it, e.g. 1%.")] = None
    allow: Allow = None
    max_rate: MaxRate = None
    unlimited: Annotated[bool, Option("--unlimited", hidden=True)] = False
    yes: Yes = False
    sequence: Annotated[str, Option(help="Sequence counts: keep, count or zero.")] = "keep"
    checksum: Annotated[str, Option(help="Checksums: keep, fix, zero or wrong.")] = "keep"
    tcp: Annotated[bool, Option("--tcp", help="SBN: send on a TCP connection.")] = False
    paused: Annotated[bool, Option("--paused", help="Paused at first: n next, space, q quits.")] = False

    def send_options(self) -> SendOptions:
        """Return these options in the form that pipelines take.

        Raises:
            typer.BadParameter: a role or rule does not exist.
        """
        from edoras_tools.pipelines.sending.options import Role, SendOptions
        from edoras_tools.sessions.outgoing import ChecksumRule, SequenceRule

        wait_ns = _TIMEOUT_NS if self.timeout is None else self.timeout
        return SendOptions(
            target=self.target,
            sender=self.sender,
            role=one_of(Role, self.role, "--role"),
            listen=self.listen,
            no_listen=self.no_listen,
            wait_for=tuple(self.wait_for or ()),
            timeout_ns=wait_ns,
            linger_ns=self.linger,
            expect=tuple(item for item in self.expect or () if not Path(item).is_file()),
            expect_runs=tuple(Path(item) for item in self.expect or () if Path(item).is_file()),
            rooms=tuple(self.tolerance or ()),
            expect_ns=wait_ns if self.expect_within is None else self.expect_within,
            max_loss=self.max_loss,
            allow=tuple(self.allow or ()),
            max_rate_hz=self.max_rate or 0.0,
            unlimited=self.unlimited or self.max_rate == 0,
            confirmed=self.yes,
            sequence=one_of(SequenceRule, self.sequence, "--sequence"),
            checksum=one_of(ChecksumRule, self.checksum, "--checksum"),
            step=self.paused,
            tcp=self.tcp,
        )


class EndingOptions(NamedTuple):
    """Settings of the recording and the report of a command that sends."""

    output: recordings.Output = None
    force: recordings.Force = False
    dry_run: DryRun = False
    printing: options.PrintOptions = options.PrintOptions()


def one_of(kind: Any, text: str, option: str) -> Any:
    """Read a value of an enumeration."""
    try:
        return kind(text.lower())
    except ValueError:
        raise BadParameter(f"{option}: {text!r} is not one of {', '.join(kind)}") from None


def carry_out(
    transmission: Transmission,
    bench: Workbench,
    faults: FaultPlan,
    ending: EndingOptions,
    inputs: tuple[Path, ...] = (),
) -> None:
    """Send the datagrams, or print the plan, and report the result.

    Args:
        ending: settings of recording and report, and whether to send at all.
        inputs: input files, which must not be overwritten.

    Raises:
        EdorasError: sending failed.
        typer.Exit: with code 3, if a datagram was certainly lost, or more than accepted, if an expected
        result
            did not come, or if the recording was removed; with code 130, if Ctrl-C ended it too early.
    """
    from edoras_tools.pipelines.sending.responses import AwaitedResults
    from edoras_tools.render.sending.status import send_status

    send_options, (json, quiet) = transmission.options, ending.printing
    if send_options.expect_ns != send_options.timeout_ns and not send_options.expect:
        raise ConfigError("--expect-within is how long --expect waits: name what is expected")
    expected = AwaitedResults.of(send_options.expect, send_options.expect_ns, bench.columns.context)
    machine = None
    if faults:
        from edoras_tools.pipelines.faults import compiler

        machine = faults.start(where=compiler(bench), headers=transmission.options.headers)
    if ending.dry_run:
        plan = {**transmission.plan(), "faults": [str(rule) for rule in faults.rules]}
        if json:
            print_json(plan)
        else:
            _print(plan)
        return
    assert send_options.target is not None
    asks = confirm_targets(send_options.target, confirmed=send_options.confirmed)
    if send_options.listen is not None:
        tell_reach(send_options.listen, "answer", instead="--no-listen receives no answers")
    keys = None
    if send_options.step or asks:
        from edoras_tools.pipelines.reading import Keys

        keys = Keys()
    with ExitStack() as stack:
        goal = _goal(send_options, ending, inputs, stack)
        recording = None
        if goal:
            from edoras_tools.pipelines.sending.run import SentRecording

            recording = partial(SentRecording, target=goal, bench=bench)
        with send_status(transmission.total, quiet=quiet, keys=keys is not None) as watcher:
            report = transmission.run(
                faults=machine, keys=keys, watcher=watcher, recording=recording, expected=expected
            )
        summary, unlike = report.summary(), list[str]()
        for good in () if goal is None or report.failure else send_options.expect_runs:
            assert goal is not None
            lines = doors.part("expected_run")(good, goal.path, bench, dict(send_options.rooms))
            item = {"expect": str(good), "met": not lines, "found": "; ".join(lines) or "alike"}
            summary["expected"].append(item)
            unlike += [f"--expect {good}: {line}" for line in lines]
    if json:
        print_json(summary)
    elif not quiet:
        _print(summary, str(send_options.target))
    end(failure=report.failure)
    lost_outputs(report.losses)
    reasons = [*report.beyond(send_options.max_loss), *unlike]
    end(*reasons, lost=reasons or (send_options.max_loss is None and report.lost))
    if report.signalled and transmission.total:
        raise Exit(INTERRUPTED)


def _goal(
    send_options: SendOptions, ending: EndingOptions, inputs: tuple[Path, ...], stack: ExitStack
) -> RecordingTarget | None:
    """Return the recording's target: that of -o, or a temporary file for a comparison with a good run."""
    output = ending.output
    if send_options.expect_runs and output is None:
        output = Path(stack.enter_context(TemporaryDirectory())) / "run.mcap"
    goal = recordings.recording_target(
        output, force=ending.force, inputs=(*inputs, *send_options.expect_runs)
    )
    if goal and send_options.over_tcp:
        raise ConfigError("-o records datagrams: over TCP capture the connection with edoras record -i lo")
    return goal


def _print(summary: dict[str, Any], target: str = "") -> None:
    """Print the plan; or, with a target, the result."""
    from edoras_tools.render.sending import replay as view
    from edoras_tools.render.terminal.palette import error_console

    if target:
        error_console().print(view.outcome(summary, target))
    else:
        print_view(view.plan(summary))


def confirm_targets(*targets: Endpoint, confirmed: bool) -> bool:
    """Allow other machines as targets only if the user confirms; return whether a user can be asked.

    Raises:
        ConfigError: one is not confirmed.
    """
    from edoras_tools.pipelines.sending.options import check_target

    asks = sys.stdin is not None and sys.stdin.isatty() and sys.stderr.isatty()
    for target in targets:
        check_target(target, confirmed=confirmed, confirm=partial(confirm, err=True) if asks else None)
    return asks
