"""``edoras decode``: one packet as a tree and its bytes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

from typer import Argument, Option

from edoras_tools.cli import options
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import print_json, tell
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import READ_PACKED


@grouped
def decode(
    *,
    arguments: Annotated[
        list[str],
        Argument(
            metavar="FILE... N",
            help=f"{READ_PACKED}; - is stdin; several are merged. N is the packet's number in sniff, from 1.",
        ),
    ],
    read: Annotated[list[Path] | None, Option("--read", "-r", hidden=True)] = None,
    layer: Annotated[str, Option("--layer", "-l", help="Highlight LAYER, or LAYER.FIELD, in bytes.")] = "",
    frame: Annotated[bool, Option("--frame", help="Dump the whole frame, not only the UDP payload.")] = False,
    json: options.Json = False,
    decoding: options.DecodingOptions,
) -> None:
    """Show one packet in full: every layer, field and byte."""
    from edoras_tools.pipelines.capture.packet_json import as_json
    from edoras_tools.pipelines.capture.sniff import decode_packet
    from edoras_tools.render.capture.watch import Followed

    *files, last = arguments
    paths = [*(read or ()), *map(Path, files)]
    if not paths:
        raise ConfigError("name the file and the packet's number: edoras decode FILE N")
    number = options.count(last)
    source, bench = open_input(InputOptions(FileOptions(paths)), decoding.settings(), messages=True)
    decoded = decode_packet(Followed(source, quiet=json), bench, number)
    tell(*bench.columns.context.notes)
    if json:
        print_json(as_json(decoded))
        return
    from edoras_tools.render.capture import tree
    from edoras_tools.render.terminal.palette import detect_terminal

    terminal = detect_terminal(sys.stdout)
    lines = tree.packet_lines(
        decoded, terminal.width, colour=terminal.colour, highlight=layer, base="frame" if frame else "payload"
    )
    sys.stdout.write("\n".join(lines) + "\n")
