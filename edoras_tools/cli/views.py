"""What ``edoras sniff`` prints instead of its list: fields, a sequence diagram, statistics."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

from edoras_tools.cli.output import print_json
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.older import StrEnum
from edoras_tools.render.units import TimeFormat

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from edoras_tools.decode.filters.rows import ColumnRows
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench


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
    """What is counted."""

    ROUTES = "routes"
    SBN = "sbn"
    SIZES = "sizes"
    FINDINGS = "findings"


class ViewOptions(NamedTuple):
    """How packets are shown."""

    tree: Annotated[bool, "-V --tree", "All layers and fields of each packet."] = False
    hexdump: Annotated[bool, "-x --hex", "The bytes of each packet."] = False
    json: Annotated[bool, "One JSON object per line."] = False
    tui: Annotated[bool, "Packet list, layers and bytes in three panes; ? shows the keys."] = False
    time: Annotated[TimeFormat | None, "--time -t", "Format of the list's time; default relative."] = None
    findings: Annotated[bool, "Only packets with a warning or an error."] = False
    fields: Annotated[
        str | None, "A,B,C", "Only these fields, one row per packet, e.g. 'time,msg_id,pose.position.x'."
    ] = None
    layout: Annotated[
        FieldFormat | None, "--format FORMAT", "Format of --fields: table (default), csv or tsv."
    ] = None
    sequence: Annotated[
        Diagram | None,
        "FORMAT",
        "A sequence diagram, with repeated packets on one line: mermaid or plantuml.",
    ] = None
    stat: Annotated[
        list[Statistic] | None, "KIND", "Only a table: routes, sbn, sizes or findings; repeatable."
    ] = None

    @property
    def time_format(self) -> TimeFormat:
        """The format of the list's time."""
        return self.time or TimeFormat.RELATIVE

    def check(self, *, verbose: bool) -> None:
        """Refuse several views at the same time, and options that the view does not have.

        Args:
            verbose: whether ``-v`` is given.

        Raises:
            ConfigError: more than one view is given, or an option without an effect.
        """
        wanted = {
            "--fields": self.fields,
            "--sequence": self.sequence,
            "--stat": self.stat,
            "--json": self.json and not self.stat,
            "-V": self.tree,
            "-x": self.hexdump,
            "--tui": self.tui,
        }
        asked = [name for name, value in wanted.items() if value]
        if len(asked) > 1:
            raise ConfigError(f"{' and '.join(asked)} exclude each other; choose one")
        if self.layout and not self.fields:
            raise ConfigError("--format is the format of --fields; name fields, or leave it out")
        view = asked[0] if asked else "--stat" if self.stat else ""
        for name, given in {"--time": self.time, "-v": verbose}.items():
            if given and view not in {"", "--tui"}:
                raise ConfigError(f"{name} has no effect with {view}; leave one of them out")

    def check_recorded(self, source: Source, *, every: bool) -> None:
        """Refuse what a recording without datagrams cannot show; the source is then closed.

        Args:
            every: whether ``-a`` is given.

        Raises:
            ConfigError: something cannot be shown.
        """
        given = {
            "--tui": self.tui,
            "--sequence": self.sequence,
            "--stat sbn": Statistic.SBN in (self.stat or ()),
            "-a": every,
        }
        for name, what in _NEED_DATAGRAMS.items():
            if given[name]:
                source.close()
                raise ConfigError(f"{source.info.name}: has messages and no datagrams, and {what} datagrams")


_NEED_DATAGRAMS: Final = {
    "--tui": "the panes show",
    "--sequence": "a sequence diagram shows who sends",
    "--stat sbn": "SBN is in",
    "-a": "-a also shows",
}
"""What cannot be used with recordings without datagrams, and the words in front of "datagrams"."""


def print_packets(blocks: Iterable[list[str]], header: str, *, flush: bool) -> int:
    """Print what is shown of packets as they come, below a header if there is one; return their number."""
    out, shown = sys.stdout, 0
    for block in blocks:
        if header and block and not shown:
            out.write(f"{header}\n")
        out.writelines(f"{text}\n" for text in block)
        if block and (flush or not shown):
            out.flush()
        shown += len(block)
    return shown


def print_fields(
    blocks: Iterable[ColumnRows], bench: Workbench, text: str, layout: FieldFormat, *, flush: bool
) -> int:
    """Print fields, one row per packet; return the number of packets.

    Raises:
        ConfigError: a name is not a field.
    """
    import csv

    from edoras_tools.decode.filters.filter import fields
    from edoras_tools.pipelines.capture.fields import column_texts, is_number
    from edoras_tools.render.capture.columns import ColumnLines
    from edoras_tools.render.terminal.terminal import look
    from edoras_tools.render.terminal.text import clean

    columns = fields(text, bench.columns.context)
    heads = [name for name, _ in columns]
    out, shown = sys.stdout, 0
    terminal = look(out)
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
            writer.writerows([heads] * (not shown))
            writer.writerows(zip(*block, strict=True))
        else:
            out.writelines("\t".join(row) + "\n" for row in [heads] * (not shown))
            out.writelines("\t".join(row) + "\n" for row in zip(*block, strict=True))
        shown += len(rows)
        if flush:
            out.flush()
    return shown


def print_sequence(blocks: Iterable[ColumnRows], bench: Workbench, diagram: Diagram) -> int:
    """Print the sequence diagram; return the number of packets."""
    from edoras_tools.pipelines.capture.conversation import Conversation
    from edoras_tools.render.capture.sequence import DIAGRAMS

    conversation, shown, read = Conversation(bench.columns.context), 0, _UntilFailure(blocks)
    for rows in read:
        conversation.add(rows)
        shown += len(rows)
    if shown:
        sys.stdout.writelines(f"{line}\n" for line in DIAGRAMS[diagram.value](conversation.messages()))
    read.end()
    return shown


@dataclass(slots=True)
class _UntilFailure:
    """Blocks of a source, whose failure waits until what was read before it is shown."""

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


def print_statistics(
    blocks: Iterable[ColumnRows], bench: Workbench, kinds: Sequence[Statistic], *, json: bool
) -> int:
    """Print tables of counts; return the number of packets."""
    from edoras_tools.pipelines.capture.statistics import Statistics

    counted, read = Statistics(bench), _UntilFailure(blocks)
    for rows in read:
        counted.add(rows)
    if not counted.ledger.datagrams:
        read.end()
    for note in counted.ledger.notes:
        sys.stderr.write(f"edoras: {note}\n")
    if json:
        print_json({kind.value: counted.table(kind.value) for kind in kinds})
        read.end()
        return counted.ledger.datagrams
    from edoras_tools.render.capture.statistics import statistics
    from edoras_tools.render.terminal.console import output_console

    console = output_console()
    for index, kind in enumerate(kinds):
        found = counted.table(kind.value)
        if index:
            console.print()
        console.print(
            statistics(kind.value, found, counted.ledger.datagrams, console.width) if found else "-"
        )
    read.end()
    return counted.ledger.datagrams
