"""``edoras sniff``: packets live or from files: one line each, or fields, a sequence diagram, statistics."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec
from msgspec.structs import replace
from typer import Option

from edoras_tools import doors
from edoras_tools.cli import options
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import no_messages, nothing_shown, print_json
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.older import StrEnum
from edoras_tools.words import TimeFormat

if TYPE_CHECKING:
    from edoras_tools.decode.context import Context
    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.model import Decoded
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.capture.packet_list import PacketList
    from edoras_tools.render.terminal.palette import Terminal


class FieldFormat(StrEnum):
    """The format of fields."""

    TABLE = "table"
    CSV = "csv"
    TSV = "tsv"


class Diagram(StrEnum):
    """The format of a sequence diagram."""

    MERMAID = "mermaid"
    PLANTUML = "plantuml"


class Statistic(StrEnum):
    """The table to print."""

    ROUTES = "routes"
    SBN = "sbn"
    SIZES = "sizes"
    FINDINGS = "findings"


STATISTICS: Final = ", ".join(Statistic)


class ViewOptions(NamedTuple):
    """How packets are shown."""

    tree: Annotated[bool, Option("-V", "--tree", help="All layers and fields of each packet.")] = False
    hexdump: Annotated[bool, Option("-x", "--hex", help="The bytes of each packet.")] = False
    json: Annotated[bool, Option("--json", help="One JSON object per line.")] = False
    tui: Annotated[bool, Option("--tui", help="Packets, layers and bytes in three panes.")] = False
    time: Annotated[TimeFormat | None, Option("--time", "-t", help="Default: relative.")] = None
    findings: Annotated[bool, Option("--findings", help="Only packets with a warning or an error.")] = False
    fields: Annotated[
        str | None, Option(metavar="A,B,C", help="Only these, a row per packet: 'time,pose.position.x'.")
    ] = None
    layout: Annotated[FieldFormat | None, Option("--format", help="Of --fields; default table.")] = None
    sequence: Annotated[Diagram | None, Option("--diagram", help="Print a sequence diagram.")] = None
    stat: Annotated[list[Statistic] | None, Option(metavar="KIND", help=f"Tables of {STATISTICS}.")] = None

    @property
    def time_format(self) -> TimeFormat:
        """The format of the list's time."""
        return self.time or TimeFormat.RELATIVE

    def check(self, *, verbose: bool) -> None:
        """Refuse several views at once, and options that have no effect on the view.

        Args:
            verbose: whether ``-v`` is given.

        Raises:
            ConfigError: more than one view is given, or an option without an effect.
        """
        views = {
            "--fields": self.fields,
            "--diagram": self.sequence,
            "--stat": self.stat,
            "--json": self.json and not self.stat,
            "-V": self.tree,
            "-x": self.hexdump,
            "--tui": self.tui,
        }
        names = [name for name, value in views.items() if value]
        if len(names) > 1:
            raise ConfigError(f"{' and '.join(names)} exclude each other; choose one")
        if self.layout and not self.fields:
            raise ConfigError("--format is the format of --fields; name fields, or leave it out")
        view = names[0] if names else "--stat" if self.stat else ""
        for name, argument in {"--time": self.time, "-v": verbose}.items():
            if argument and view not in {"", "--tui"}:
                raise ConfigError(f"{name} has no effect with {view}; leave one of them out")

    def check_recorded(self, source: Source, *, every: bool) -> None:
        """Refuse views that a recording without datagrams cannot show; the source is then closed.

        Args:
            every: whether ``-a`` is given.

        Raises:
            ConfigError: a view is impossible.
        """
        views = {
            "--tui": self.tui,
            "--diagram": self.sequence,
            "--stat sbn": Statistic.SBN in (self.stat or ()),
            "-a": every,
        }
        for name, verb in _NEED_DATAGRAMS.items():
            if views[name]:
                source.close()
                raise ConfigError(f"{source.info.name}: has messages and no datagrams, and {verb} datagrams")


_NEED_DATAGRAMS: Final = {
    "--tui": "the panes show",
    "--diagram": "a sequence diagram shows who sends",
    "--stat sbn": "SBN is in",
    "-a": "-a also shows",
}
"""Options that are impossible for recordings without datagrams, with the words in front of "datagrams"."""


def print_packets(blocks: Iterable[list[str]], header: str, *, flush: bool) -> int:
    """Print texts of packets as they come, below a header if there is one; return their number."""
    out, count = sys.stdout, 0
    for block in blocks:
        if header and block and not count:
            out.write(f"{header}\n")
        out.write("\n".join([*block, ""]))
        if block and (flush or not count):
            out.flush()
        count += len(block)
    return count


def print_fields(
    blocks: Iterable[ColumnRows], bench: Workbench, text: str, layout: FieldFormat, *, flush: bool
) -> int:
    """Print fields, one row per packet; return the number of packets.

    Raises:
        ConfigError: a name is not a field.
    """
    import csv

    from edoras_tools.decode.filters.filter import fields
    from edoras_tools.pipelines.capture.sniff import column_texts, is_number
    from edoras_tools.render.capture.packet_list import ColumnLines
    from edoras_tools.render.terminal.palette import detect_terminal
    from edoras_tools.render.terminal.text import clean

    columns = fields(text, bench.columns.context)
    heads = [name for name, _ in columns]
    out, count = sys.stdout, 0
    terminal = detect_terminal(out)
    table = ColumnLines(
        heads,
        [is_number(column) for column in columns],
        width=terminal.width if terminal.interactive else 0,
        colour=terminal.colour,
    )
    writer = csv.writer(out, lineterminator="\n")
    for rows in blocks:
        block = column_texts(rows, columns, str if layout is FieldFormat.CSV else clean)
        if layout is FieldFormat.TABLE:
            out.writelines(f"{line}\n" for line in table.lines(block))
        elif layout is FieldFormat.CSV:
            writer.writerows([heads] * (not count))
            writer.writerows(zip(*block, strict=True))
        else:
            out.writelines("\t".join(row) + "\n" for row in [heads] * (not count))
            out.writelines("\t".join(row) + "\n" for row in zip(*block, strict=True))
        count += len(rows)
        if flush:
            out.flush()
    return count


def print_sequence(blocks: Iterable[ColumnRows], bench: Workbench, diagram: Diagram) -> int:
    """Print the sequence diagram; return the number of packets."""
    from edoras_tools.pipelines.capture.conversation import Conversation
    from edoras_tools.render.capture.sequence import DIAGRAMS

    conversation, count, read = Conversation(bench.columns.context), 0, _UntilFailure(blocks)
    for rows in read:
        conversation.add(rows)
        count += len(rows)
    if count:
        sys.stdout.writelines(f"{line}\n" for line in DIAGRAMS[diagram.value](conversation.messages()))
    read.end()
    return count


class _UntilFailure(msgspec.Struct):
    """Blocks of a source, whose failure is raised after everything read before it is shown."""

    blocks: Iterable[ColumnRows]
    failure: CaptureError | None = None

    def __iter__(self) -> Iterator[ColumnRows]:
        try:
            yield from self.blocks
        except CaptureError as error:
            self.failure = error

    def end(self) -> None:
        """Raise the failure, if there was one."""
        if self.failure is not None:
            raise self.failure


def _print_counts(rows: Iterable[ColumnRows], bench: Workbench, view: ViewOptions) -> int:
    if view.sequence:
        return print_sequence(rows, bench, view.sequence)
    return print_statistics(rows, bench, view.stat or (), json=view.json)


def print_statistics(
    blocks: Iterable[ColumnRows], bench: Workbench, kinds: Sequence[Statistic], *, json: bool
) -> int:
    """Print tables of counts; return the number of packets."""
    from edoras_tools.pipelines.capture.conversation import Statistics

    totals, read = Statistics(bench), _UntilFailure(blocks)
    for rows in read:
        totals.add(rows)
    if not totals.ledger.datagrams:
        read.end()
    for note in totals.ledger.notes:
        sys.stderr.write(f"edoras: {note}\n")
    if json:
        print_json({kind.value: totals.table(kind.value) for kind in kinds})
        read.end()
        return totals.ledger.datagrams
    from edoras_tools.render.capture.info import statistics
    from edoras_tools.render.terminal.palette import output_console

    console = output_console()
    for index, kind in enumerate(kinds):
        table = totals.table(kind.value)
        if index:
            console.print()
        console.print(statistics(kind.value, table, totals.ledger.datagrams, console.width) if table else "-")
    read.end()
    return totals.ledger.datagrams


@grouped
def sniff(
    *,
    inputs: InputOptions,
    view: ViewOptions,
    every: Annotated[bool, Option("--all", "-a", help="Also UDP that belongs to no link.")] = False,
    stop: options.PartOptions,
    verbose: options.Verbose = False,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Show traffic, one line per packet, live or from files.

    Colours show the link and problems. With -v, notes are shown too, such as a checksum that is not set.
    """
    from edoras_tools.cfs.names import MSG_ID_NAMES
    from edoras_tools.links import table
    from edoras_tools.pipelines.capture.sniff import AT_ONCE
    from edoras_tools.pipelines.capture.sniff import sniff as sniffed
    from edoras_tools.pipelines.reading import selected_rows
    from edoras_tools.render.capture.packet_list import COLUMNS, LEAST_WITH_TYPE, MESSAGE_COLUMNS, PacketList
    from edoras_tools.render.capture.watch import Followed
    from edoras_tools.render.severity import NOTABLE
    from edoras_tools.render.terminal.palette import detect_terminal

    view.check(verbose=verbose)
    limits = stop.limits(inputs.paths)
    settings, selection, live = decoding.settings(), filters.selection(), not inputs.paths
    if view.tui:
        panes = doors.part("panes")
        panes.check_terminal()
    source, bench = open_input(inputs, settings, every_port=every, messages=True)
    recorded = bool(bench.mission.recorded)
    if recorded:
        view.check_recorded(source, every=every)
    any_link = recorded or every or inputs.live.listen
    selection = replace(
        selection,
        links=selection.links or (() if any_link else table.links()),
        notable=NOTABLE if view.findings else 0,
    )
    if view.tui:
        panes.show(source, bench, settings, selection, view.time_format, limits, verbose=verbose)
        return
    terminal = detect_terminal(sys.stdout)
    counts = view.sequence or view.stat
    read = Followed(source, quiet=live or not (counts or terminal.interactive))
    waits = live or "-" in map(str, inputs.paths)

    def ended(count: int) -> None:
        if recorded:
            no_messages(source, count)
        else:
            nothing_shown(source, count, bench.columns.context, live=live, every=not selection.links)

    if view.fields:
        rows = read.printed(selected_rows(read, bench, selection, limits))
        ended(print_fields(rows, bench, view.fields, view.layout or FieldFormat.TABLE, flush=waits))
        return
    if counts:
        ended(_print_counts(selected_rows(read, bench, selection, limits), bench, view))
        return
    typed = recorded and terminal.width >= LEAST_WITH_TYPE
    packet_list = PacketList(
        terminal.width,
        colour=terminal.colour,
        time_format=view.time_format,
        names=MSG_ID_NAMES,
        verbose=verbose,
        columns=MESSAGE_COLUMNS if recorded else COLUMNS,
        added=[(f"{'Type':<12}", False)] if typed else (),
    )
    args = read, bench, selection, limits, packet_list.count_from
    header, bench.dissector.detail = "", view.hexdump or view.tree
    if view.hexdump or view.tree:
        blocks = _whole(sniffed(*args), terminal, hexdump=view.hexdump)
    elif view.json:
        from edoras_tools.pipelines.capture.packet_json import PacketTexts

        blocks = map(PacketTexts(bench.columns.context).of, selected_rows(*args, most=AT_ONCE))
    else:
        header = packet_list.header()
        blocks = _listed(selected_rows(*args, most=AT_ONCE), bench.columns.context, packet_list, typed=typed)
    ended(print_packets(read.printed(blocks), header, flush=waits))


def _whole(packets: Iterable[Decoded], terminal: Terminal, *, hexdump: bool) -> Iterator[list[str]]:
    """Yield the bytes of packets, or all their layers and fields."""
    from edoras_tools.render.capture.tree import packet_lines, tree_lines
    from edoras_tools.render.terminal.palette import Paint

    for decoded in packets:
        if hexdump:
            lines = packet_lines(decoded, terminal.width, colour=terminal.colour)
        else:
            lines = tree_lines(decoded, terminal.width, Paint(terminal.colour))
        yield ["\n".join([*lines, ""])]


def _listed(
    blocks: Iterable[ColumnRows], context: Context, packet_list: PacketList, *, typed: bool
) -> Iterator[list[str]]:
    """Yield a line for each packet, ``typed`` with the type of its message behind."""
    from edoras_tools.decode.lines import PacketLines
    from edoras_tools.io.frames.linklayer import checksum_faults
    from edoras_tools.render.severity import Level
    from edoras_tools.render.terminal.text import clean

    lines = PacketLines(context)
    for rows in blocks:
        faults = checksum_faults(rows.batch.take(rows.selection))
        marks = [fault and f"{Level.ERROR.mark} {fault}  " for fault in faults]
        yield [
            packet_list.line(
                replace(line, text=mark + line.text) if mark else line,
                values=(clean(line.type.rpartition("/")[2]),) if typed else (),
            )
            for line, mark in zip(lines.of(rows), marks, strict=True)
        ]
