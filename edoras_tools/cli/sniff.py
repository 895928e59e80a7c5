"""``edoras sniff``: prints one line per packet, live or from files."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated

import typer

from edoras_tools.cli import options, views
from edoras_tools.cli.endings import nothing_shown
from edoras_tools.cli.inputs import InputOptions, open_input


@options.grouped
def sniff(
    *,
    given: InputOptions,
    view: views.ViewOptions,
    every: Annotated[bool, typer.Option("--all", "-a", help="Also UDP that belongs to no link.")] = False,
    stop: options.PartOptions,
    verbose: options.Verbose = False,
    chosen: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show CI, TO and SBN traffic, one line per packet, live or from files.

    Colours show the link and problems. With -v, notes are shown too, such as a checksum that is not set.
    """
    from edoras_tools.cfs.names import MSG_ID_NAMES
    from edoras_tools.links import table
    from edoras_tools.pipelines.capture.sniff import as_json
    from edoras_tools.pipelines.capture.sniff import sniff as packets
    from edoras_tools.render.capture import packet
    from edoras_tools.render.capture import tree as tree_view
    from edoras_tools.render.capture.packet_list import PacketList
    from edoras_tools.render.severity import NOTABLE
    from edoras_tools.render.terminal.palette import Paint
    from edoras_tools.render.terminal.terminal import look

    view.check(verbose=verbose)
    limits = stop.limits(given.paths)
    settings, selection, live = decoding.settings(), chosen.selection(), not given.paths
    selection = replace(
        selection,
        links=selection.links or (() if every or given.live.listen else table.links()),
        notable=NOTABLE if view.findings else 0,
    )
    if view.tui:
        from edoras_tools.cli.panes import check_terminal, show

        check_terminal()
    source, bench = open_input(given, settings, every_port=every)
    if view.tui:
        show(source, bench, settings, selection, view.time_format, limits, verbose=verbose)
        return
    waits = live or "-" in map(str, given.paths)
    if view.fields or view.sequence or view.stat:
        from edoras_tools.pipelines.reading import chosen as chosen_rows

        blocks = chosen_rows(source, bench, selection=selection, limits=limits)
        if view.fields:
            shown = views.print_fields(
                blocks, bench, view.fields, view.layout or views.FieldFormat.TABLE, flush=waits
            )
        elif view.sequence:
            shown = views.print_sequence(blocks, bench, view.sequence)
        else:
            shown = views.print_statistics(blocks, bench, view.stat or (), json=view.json)
        nothing_shown(source, shown, bench.columns.context, live=live, every=not selection.links)
        return
    bench.dissector.detail = view.tree or view.hexdump
    terminal = look(sys.stdout)
    packet_list = PacketList(
        terminal.width,
        colour=terminal.colour,
        time_format=view.time_format,
        names=MSG_ID_NAMES,
        verbose=verbose,
    )
    shown = 0
    out = sys.stdout
    if view.json:
        from json import dumps
    for decoded in packets(source, bench, selection=selection, limits=limits, started=packet_list.count_from):
        if view.json:
            out.write(dumps(as_json(decoded), ensure_ascii=False, separators=(",", ":")) + "\n")
        elif view.hexdump:
            out.write(
                "\n".join(packet.packet_lines(decoded, terminal.width, colour=terminal.colour)) + "\n\n"
            )
        elif view.tree:
            out.write(
                "\n".join(tree_view.tree_lines(decoded, terminal.width, Paint(terminal.colour))) + "\n\n"
            )
        else:
            if not shown:
                out.write(packet_list.header() + "\n")
            out.write(packet_list.line(decoded) + "\n")
        shown += 1
        if waits or shown == 1:
            out.flush()
    nothing_shown(source, shown, bench.columns.context, live=live, every=not selection.links)
