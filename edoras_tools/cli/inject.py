"""``edoras inject``: one message or command, once or at a rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options, sending

if TYPE_CHECKING:
    from edoras_tools.pipelines.orders import Orders
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.sessions.faults import FaultPlan


def hexadecimal(text: str) -> bytes:
    """Read bytes in hex; blanks and colons may stand between them."""
    try:
        return bytes.fromhex(text.removeprefix("0x").replace(":", " "))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no row of bytes in hex; write '01 ff' or 01ff") from None


@options.takes_decoding
@sending.takes_sending
@options.takes_faults
def inject(
    settings: Settings,
    orders: Orders,
    faults: FaultPlan,
    what: Annotated[
        str, typer.Argument(metavar="[WHAT]", help="A topic; or a command: to-enable, noop APP, ci-noop ...")
    ] = "",
    values: Annotated[
        str, typer.Argument(metavar="[MESSAGE]", help="Its fields as YAML or JSON, or @FILE; or an argument.")
    ] = "",
    to: Annotated[
        str,
        typer.Option("--to", metavar="TO", help="To ci, sbn or ground; where its route leads if not said."),
    ] = "",
    command: Annotated[
        tuple[str, str] | None,
        typer.Option("--command", metavar="MSGID CODE", help="A command packet instead: MsgId and code."),
    ] = None,
    payload: Annotated[
        Any,
        typer.Option("--hex", metavar="BYTES", parser=hexadecimal, help="Behind the header of --command."),
    ] = None,
    code: Annotated[
        int | None,
        typer.Option("--code", metavar="N", parser=options.number, help="Function code of a message; 1."),
    ] = None,
    rate: Annotated[
        float | None,
        typer.Option("--hz", metavar="HZ", parser=sending.positive, help="So often a second; 1."),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "--count",
            "-n",
            metavar="N",
            parser=options.counted,
            help="So often; with --hz alone without end.",
        ),
    ] = None,
    arbitrary: Annotated[
        bool, typer.Option("--every-field-random", help="Make all values up, new ones each time; --seed.")
    ] = False,
    output: sending.Output = None,
    dry_run: sending.DryRun = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Send one ROS message or one command, once or at a rate.

    For example: edoras inject /cmd_vel '{linear: {x: 0.5}}' -c rover.yaml --hz 10 -n 50
    """
    from dataclasses import replace

    from edoras_tools.errors import ConfigError
    from edoras_tools.pipelines.inject import Order, make, receiver
    from edoras_tools.pipelines.orders import To
    from edoras_tools.pipelines.transmission import Transmission
    from edoras_tools.sessions.outgoing import Changes

    if bool(what) == bool(command):
        raise ConfigError("name one thing: a topic, a command's name, or --command MSGID CODE")
    if payload is not None and not command:
        raise ConfigError("--hex goes behind the header of --command; name that too")
    order = Order(
        what,
        values,
        (options.msg_id(command[0]), options.number(command[1])) if command else None,
        payload or b"",
        1 if code is None else code,
        count or (0 if rate else 1),
        arbitrary,
        faults.seed,
    )
    bench = settings.workbench()
    orders = replace(
        orders,
        to=sending.one_of(To, to, "--to") if to else receiver(order, bench.mission),
        rates=(("*", rate or 1.0),),
    ).placed(bench.mission)
    loaded, orders = make(order, bench, orders)
    changes = Changes(sequence=orders.sequence, checksum=orders.checksum)
    transmission = Transmission.of(loaded, orders, bench.mission, changes)
    sending.carry_out(transmission, bench, faults, output=output, dry_run=dry_run, json=json, quiet=quiet)
