"""Messages from the threads to the view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from textual.message import Message

from edoras_tools.render.severity import Level

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray
    from rich.text import Text

    from edoras_tools.addons.tui.data.store import PacketBlock
    from edoras_tools.decode.filters.filter import Where
    from edoras_tools.render.capture.sequence import SequenceMessage as Run
    from edoras_tools.render.plot.figure import Figure


class Arrived(Message):
    """A block of packets arrived."""

    def __init__(self, block: PacketBlock) -> None:
        super().__init__()
        self.block = block


class Ended(Message):
    """Reading ended."""

    def __init__(self, why: str, *, failed: bool) -> None:
        super().__init__()
        self.why = why
        self.failed = failed


class FilterAnswer(Message):
    """A filter was run on a block."""

    def __init__(self, where: Where, block: PacketBlock, rows: NDArray[np.int64]) -> None:
        super().__init__()
        self.where = where
        self.block = block
        self.rows = rows


class Found(Message):
    """A search has ended."""

    def __init__(self, text: str, number: int | None) -> None:
        super().__init__()
        self.text = text
        self.number = number


class ConversationReady(Message):
    """The runs of a conversation were found."""

    def __init__(self, runs: list[Run]) -> None:
        super().__init__()
        self.runs = runs


class Sorted(Message):
    """The order of the rows of the list was found."""

    def __init__(self, column: str, order: NDArray[np.int64], forgotten: int) -> None:
        super().__init__()
        self.column = column
        self.order = order
        self.forgotten = forgotten


class RatesReady(Message):
    """The rates of the packets of the list were counted; None if there is no packet."""

    def __init__(self, figure: Figure | None) -> None:
        super().__init__()
        self.figure = figure


class TraceReady(Message):
    """The way of a packet's message, drawn for a width; why there is none, as a text."""

    def __init__(self, ladder: Callable[[int], list[Text]] | str) -> None:
        super().__init__()
        self.ladder = ladder


class Notice(Message):
    """A text for the status bar."""

    def __init__(self, text: str, severity: Level = Level.NOTE) -> None:
        super().__init__()
        self.text = text
        self.severity = severity
