"""``edoras sniff``: one line a packet, live or from files."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from edoras_tools.cli import options, views

if TYPE_CHECKING:
    from edoras_tools.pipelines.selection import Selection
    from edoras_tools.pipelines.workbench import Settings


class Time(StrEnum):
    """How to tell time."""

    RELATIVE = "relative"
    DELTA = "delta"
    UTC = "utc"
    EPOCH = "epoch"


@options.takes_decoding
@options.takes_choice
def sniff(
    settings: Settings,
    selection: Selection,
    read: options.Read = None,
    interface: options.Interface = None,
    listen: options.Listen = None,
    tree: Annotated[bool, typer.Option("-V", "--tree", help="Every layer and field of each packet.")] = False,
    hexdump: Annotated[bool, typer.Option("-x", "--hex", help="The bytes of each packet.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object a line.")] = False,
    tui: Annotated[
        bool, typer.Option("--tui", help="Packet list, layers and bytes, to move about in; ? there says how.")
    ] = False,
    time: Annotated[Time, typer.Option("--time", "-t", help="How to tell time.")] = Time.RELATIVE,
    findings: Annotated[
        bool, typer.Option("--findings", help="Only packets with a warning or an error.")
    ] = False,
    fields: views.Fields = None,
    layout: views.Format = views.Layout.TABLE,
    sequence: views.Drawn = None,
    stat: views.Stat = None,
    every: Annotated[bool, typer.Option("--all", "-a", help="Also UDP that belongs to no link.")] = False,
    count: options.Count = None,
    duration: options.Duration = None,
    verbose: options.Verbose = False,
) -> None:
    """Show CI, TO and SBN traffic, one line a packet: live or from files.

    Colours tell the link and what is wrong. Notes, as a checksum that nobody sends, show with -v.
    """
    from dataclasses import replace
    from time import monotonic_ns

    from edoras_tools.cli.endings import nothing_shown
    from edoras_tools.cli.inputs import open_input
    from edoras_tools.model import Link
    from edoras_tools.pipelines.sniff import as_json
    from edoras_tools.pipelines.sniff import sniff as packets
    from edoras_tools.render import packet
    from edoras_tools.render import tree as tree_view
    from edoras_tools.render.packet_list import PacketList, TimeFormat
    from edoras_tools.render.palette import Paint
    from edoras_tools.render.severity import NOTABLE
    from edoras_tools.render.terminal import look
    from edoras_tools.wire.names import MSG_ID_NAMES

    views.check_one(
        ("--fields", fields),
        ("--sequence", sequence),
        ("--stat", stat),
        ("--json", json and not stat),
        ("-V", tree),
        ("-x", hexdump),
        ("--tui", tui),
    )
    chosen = replace(
        selection,
        links=selection.links or (() if every or listen else (Link.CI, Link.TO, Link.SBN)),
        notable=NOTABLE if findings else 0,
    )
    if tui:
        from edoras_tools.cli.panes import check_terminal, show

        check_terminal()
    source, bench = open_input(read, interface, listen, settings, every_port=every)
    if tui:
        show(source, bench, settings, chosen, time.value, count=count, duration_ns=duration, verbose=verbose)
        return
    waits = read is None or str(read[0]) == "-"
    limits: dict[str, Any] = {"count": count or 0, "clock": monotonic_ns, "duration_ns": duration or 0}
    if fields or sequence or stat:
        from edoras_tools.pipelines.chosen import chosen as chosen_rows

        blocks = chosen_rows(source, bench, selection=chosen, **limits)
        if fields:
            shown = views.print_fields(blocks, bench, fields, layout, flush=waits)
        elif sequence:
            shown = views.print_sequence(blocks, bench, sequence)
        else:
            shown = views.print_statistics(blocks, bench, stat or (), json=json)
        nothing_shown(source, shown, live=read is None)
        return
    bench.dissector.detail = tree or hexdump
    terminal = look(sys.stdout)
    view = PacketList(
        terminal.width,
        colour=terminal.colour,
        time_format=TimeFormat(time.value),
        names=MSG_ID_NAMES,
        verbose=verbose,
    )
    shown = 0
    out = sys.stdout
    if json:
        from json import dumps
    for decoded in packets(source, bench, selection=chosen, **limits):
        if json:
            out.write(dumps(as_json(decoded), ensure_ascii=False, separators=(",", ":")) + "\n")
        elif hexdump:
            out.write("\n".join(packet.lines(decoded, terminal.width, colour=terminal.colour)) + "\n\n")
        elif tree:
            out.write("\n".join(tree_view.lines(decoded, terminal.width, Paint(terminal.colour))) + "\n\n")
        else:
            if not shown:
                out.write(view.header() + "\n")
            out.write(view.line(decoded) + "\n")
        shown += 1
        if waits or shown == 1:
            out.flush()
    nothing_shown(source, shown, live=read is None)
