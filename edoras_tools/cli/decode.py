"""``edoras decode``: one packet as a tree and its bytes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.cli import options

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Settings


@options.takes_decoding
def decode(
    settings: Settings,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="pcap, pcapng or MCAP; - is stdin.")],
    number: Annotated[
        int, typer.Argument(metavar="N", parser=options.counted, help="The packet's number, from 1.")
    ],
    layer: Annotated[
        str,
        typer.Option("--layer", "-l", metavar="NAME", help="Point at a layer, or LAYER.FIELD, in the bytes."),
    ] = "",
    frame: Annotated[
        bool, typer.Option("--frame", help="Dump the whole frame, not only the UDP payload.")
    ] = False,
    json: options.Json = False,
) -> None:
    """Take one packet apart: every layer and field, and which bytes they are."""
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.pipelines.sniff import as_json, find

    source, bench = open_input([file], None, None, settings)
    decoded = find(source, bench, number)
    if json:
        from edoras_tools.cli.output import print_json

        print_json(as_json(decoded))
        return
    from edoras_tools.render import packet
    from edoras_tools.render.terminal import look

    terminal = look(sys.stdout)
    lines = packet.lines(
        decoded, terminal.width, colour=terminal.colour, chosen=layer, base="frame" if frame else "payload"
    )
    sys.stdout.write("\n".join(lines) + "\n")
