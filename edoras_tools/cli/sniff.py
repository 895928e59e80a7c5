"""``edoras sniff``: prints one line per packet, live or from files."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from edoras_tools import doors
from edoras_tools.cli import options, views
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import no_messages, nothing_shown
from edoras_tools.cli.inputs import InputOptions, open_input

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.model import Decoded
    from edoras_tools.render.capture.packet_list import PacketList
    from edoras_tools.render.terminal.terminal import Terminal


@grouped
def sniff(
    *,
    given: InputOptions,
    view: views.ViewOptions,
    every: Annotated[bool, "--all -a", "Also UDP that belongs to no link."] = False,
    stop: options.PartOptions,
    verbose: options.Verbose = False,
    chosen: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show traffic, one line per packet, live or from files.

    Colours show the link and problems. With -v, notes are shown too, such as a checksum that is not set.
    """
    from edoras_tools.cfs.names import MSG_ID_NAMES
    from edoras_tools.links import table
    from edoras_tools.pipelines.capture.sniff import AT_ONCE
    from edoras_tools.pipelines.capture.sniff import sniff as sniffed
    from edoras_tools.pipelines.reading import chosen as chosen_rows
    from edoras_tools.render.capture.packet_list import COLUMNS, LEAST_WITH_TYPE, MESSAGE_COLUMNS, PacketList
    from edoras_tools.render.capture.watch import Followed
    from edoras_tools.render.severity import NOTABLE
    from edoras_tools.render.terminal.terminal import look

    view.check(verbose=verbose)
    limits = stop.limits(given.paths)
    settings, selection, live = decoding.settings(), chosen.selection(), not given.paths
    if view.tui:
        panes = doors.part("panes")
        panes.check_terminal()
    source, bench = open_input(given, settings, every_port=every, messages=True)
    recorded = bool(bench.mission.recorded)
    if recorded:
        view.check_recorded(source, every=every)
    any_link = recorded or every or given.live.listen
    selection = replace(
        selection,
        links=selection.links or (() if any_link else table.links()),
        notable=NOTABLE if view.findings else 0,
    )
    if view.tui:
        panes.show(source, bench, settings, selection, view.time_format, limits, verbose=verbose)
        return
    terminal = look(sys.stdout)
    counts = view.sequence or view.stat
    read = Followed(source, quiet=live or not (counts or terminal.interactive))
    waits = live or "-" in map(str, given.paths)

    def ended(shown: int) -> None:
        if recorded:
            no_messages(source, shown)
        else:
            nothing_shown(source, shown, bench.columns.context, live=live, every=not selection.links)

    if view.fields or view.sequence or view.stat:
        rows = chosen_rows(read, bench, selection, limits)
        if view.fields:
            shown = views.print_fields(
                read.printed(rows), bench, view.fields, view.layout or views.FieldFormat.TABLE, flush=waits
            )
        elif view.sequence:
            shown = views.print_sequence(rows, bench, view.sequence)
        else:
            shown = views.print_statistics(rows, bench, view.stat or (), json=view.json)
        ended(shown)
        return
    typed = recorded and terminal.width >= LEAST_WITH_TYPE
    packet_list = PacketList(
        terminal.width,
        colour=terminal.colour,
        time_format=view.time_format,
        names=MSG_ID_NAMES,
        verbose=verbose,
        shown=MESSAGE_COLUMNS if recorded else COLUMNS,
        added=[(f"{'Type':<12}", False)] if typed else (),
    )
    taken = read, bench, selection, limits, packet_list.count_from
    header, bench.dissector.detail = "", view.hexdump or view.tree
    if view.hexdump or view.tree:
        blocks = _whole(sniffed(*taken), terminal, hexdump=view.hexdump)
    elif view.json:
        from edoras_tools.pipelines.capture.packet_json import PacketTexts

        blocks = map(PacketTexts(bench.columns.context).of, chosen_rows(*taken, most=AT_ONCE))
    else:
        header = packet_list.header()
        blocks = _listed(chosen_rows(*taken, most=AT_ONCE), bench.columns.context, packet_list, typed=typed)
    ended(views.print_packets(read.printed(blocks), header, flush=waits))


def _whole(packets: Iterable[Decoded], terminal: Terminal, *, hexdump: bool) -> Iterator[list[str]]:
    """Yield the bytes of packets, or all their layers and fields."""
    from edoras_tools.render.capture.packet import packet_lines
    from edoras_tools.render.capture.tree import tree_lines
    from edoras_tools.render.terminal.palette import Paint

    for decoded in packets:
        if hexdump:
            shown = packet_lines(decoded, terminal.width, colour=terminal.colour)
        else:
            shown = tree_lines(decoded, terminal.width, Paint(terminal.colour))
        yield ["\n".join([*shown, ""])]


def _listed(
    blocks: Iterable[ColumnRows], context: Context, packet_list: PacketList, *, typed: bool
) -> Iterator[list[str]]:
    """Yield a line for each packet, ``typed`` with the type of its message behind."""
    from edoras_tools.decode.lines import PacketLines
    from edoras_tools.render.terminal.text import clean

    made = PacketLines(context)
    for rows in blocks:
        yield [
            packet_list.line(line, values=(clean(line.type.rpartition("/")[2]),) if typed else ())
            for line in made.of(rows)
        ]
