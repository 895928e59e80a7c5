"""``edoras codegen``: messages in C for flight software."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from edoras_tools.cli import options


def codegen(
    types: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[TYPE]...",
            help="Message types, as geometry_msgs/msg/Twist; a package for all of its own.",
        ),
    ] = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the files.")
    ] = Path("edoras_msgs"),
    config: options.Config = None,
    bound: Annotated[
        list[str] | None,
        typer.Option(
            "--bound",
            metavar="TYPE.FIELD=N",
            help="Most elements of a sequence, or characters of a string; "
            "TYPE.FIELD[]=N: of each string in it; repeatable.",
        ),
    ] = None,
    strings: Annotated[int, typer.Option(metavar="N", min=1, help="Most characters of other strings.")] = 64,
    sequences: Annotated[
        int, typer.Option(metavar="N", min=1, help="Most elements of other sequences.")
    ] = 32,
    pool: Annotated[
        int,
        typer.Option(metavar="N", min=1, help="Messages of a type that are in use at once."),
    ] = 4,
    envelope: Annotated[
        str, typer.Option(metavar="FORMAT", help="EDORAS envelope: 8/8, 4/4 or 1/1, with le or be.")
    ] = "8/8 le",
    distro: options.Distro = "humble",
    msg_path: options.MsgPath = None,
    quiet: options.Quiet = False,
) -> None:
    """Write messages in C for flight software: structs, CDR, the functions of edoras_core; no ROS, no heap.

    For example: edoras codegen -c MISSION --bound sensor_msgs/msg/JointState.name=16 -o fsw/src/edoras_msgs
    """
    from edoras_tools.codegen import Bounds, Order, Rule, generate, summary, write
    from edoras_tools.mission import load
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.envelope import EnvelopeFormat

    store = TypeStore(distro, msg_path or ())
    mission = load(config or (), check_type=store.check)
    rules = tuple(Rule.read(text) for text in bound or ())
    order = Order(
        tuple(types or ()), Bounds(strings, sequences, rules), mission, pool, EnvelopeFormat.named(envelope)
    )
    made = generate(store, order)
    removed = write(output, made.files)
    if not quiet:
        sys.stdout.write("".join(f"{line}\n" for line in summary(made, output, removed)))
