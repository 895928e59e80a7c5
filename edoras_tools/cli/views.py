"""What ``edoras sniff`` prints instead of its list: fields, a sequence diagram, statistics."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated

import typer

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.decode.where_rows import ColumnRows
    from edoras_tools.pipelines.workbench import Workbench


class Layout(StrEnum):
    """How fields are laid out."""

    TABLE = "table"
    CSV = "csv"
    TSV = "tsv"


class Diagram(StrEnum):
    """What draws a sequence diagram."""

    MERMAID = "mermaid"
    PLANTUML = "plantuml"


class Statistic(StrEnum):
    """What is counted."""

    ROUTES = "routes"
    SBN = "sbn"
    SIZES = "sizes"
    FINDINGS = "findings"


Fields = Annotated[
    str | None,
    typer.Option(
        metavar="A,B,C", help="Only these fields, a row a packet, as 'time,msg_id,pose.position.x'."
    ),
]
Format = Annotated[
    Layout, typer.Option("--format", metavar="FORMAT", help="How --fields is laid out: table, csv or tsv.")
]
Drawn = Annotated[
    Diagram | None,
    typer.Option(
        "--sequence",
        metavar="FORMAT",
        help="The conversation as a sequence diagram, repeated packets folded: mermaid or plantuml.",
    ),
]
Stat = Annotated[
    list[Statistic] | None,
    typer.Option(metavar="KIND", help="Only a table: routes, sbn, sizes or findings; repeatable."),
]


def check_one(*views: tuple[str, object]) -> None:
    """Refuse several views at once.

    Raises:
        ConfigError: more than one is asked for.
    """
    asked = [name for name, wanted in views if wanted]
    if len(asked) > 1:
        raise ConfigError(f"{' and '.join(asked)} do not go together; choose one")


def print_fields(
    blocks: Iterable[ColumnRows], bench: Workbench, text: str, layout: Layout, *, flush: bool
) -> int:
    """Print fields, a row a packet; return how many packets there were.

    Raises:
        ConfigError: a name is no field.
    """
    import csv

    from edoras_tools.decode.where import fields
    from edoras_tools.pipelines.fields import cells, is_number
    from edoras_tools.render.columns import ColumnLines
    from edoras_tools.render.terminal import look
    from edoras_tools.render.text import clean

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
        block = cells(rows, columns, str if layout is Layout.CSV else clean)
        if layout is Layout.TABLE:
            out.writelines(f"{line}\n" for line in table.lines(block))
        elif layout is Layout.CSV:
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
    """Print the conversation; return how many packets there were."""
    from edoras_tools.pipelines.conversation import Conversation
    from edoras_tools.render.sequence import DIAGRAMS

    conversation, shown = Conversation(bench.columns.context), 0
    for rows in blocks:
        conversation.add(rows)
        shown += len(rows)
    if shown:
        sys.stdout.writelines(f"{line}\n" for line in DIAGRAMS[diagram.value](conversation.messages()))
    return shown


def print_statistics(
    blocks: Iterable[ColumnRows], bench: Workbench, kinds: Sequence[Statistic], *, json: bool
) -> int:
    """Print tables of counts; return how many packets there were."""
    from edoras_tools.pipelines.statistics import Statistics

    counted = Statistics(bench)
    for rows in blocks:
        counted.add(rows)
    if json:
        from edoras_tools.cli.output import print_json

        print_json({kind.value: counted.table(kind.value) for kind in kinds})
        return counted.ledger.datagrams
    from edoras_tools.render.console import output_console
    from edoras_tools.render.statistics import statistics

    console = output_console()
    for index, kind in enumerate(kinds):
        found = counted.table(kind.value)
        if index:
            console.print()
        console.print(
            statistics(kind.value, found, counted.ledger.datagrams, console.width) if found else "-"
        )
    return counted.ledger.datagrams
