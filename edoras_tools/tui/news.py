"""What threads tell the view."""

from __future__ import annotations

from typing import TYPE_CHECKING

from textual.message import Message

from edoras_tools.render.severity import Severity

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.decode.where import Where
    from edoras_tools.render.sequence import Message as Run
    from edoras_tools.tui.store import Block


class Arrived(Message):
    """Packets came."""

    def __init__(self, block: Block) -> None:
        super().__init__()
        self.block = block


class Ended(Message):
    """No more will come."""

    def __init__(self, why: str, *, failed: bool) -> None:
        super().__init__()
        self.why = why
        self.failed = failed


class Settled(Message):
    """A filter has answered for a block."""

    def __init__(self, where: Where, block: Block, shown: NDArray[np.int64]) -> None:
        super().__init__()
        self.where = where
        self.block = block
        self.shown = shown


class Found(Message):
    """A search has ended."""

    def __init__(self, text: str, number: int | None) -> None:
        super().__init__()
        self.text = text
        self.number = number


class Folded(Message):
    """A conversation has been gathered."""

    def __init__(self, runs: list[Run]) -> None:
        super().__init__()
        self.runs = runs


class Said(Message):
    """Something to say in the status bar."""

    def __init__(self, text: str, severity: Severity = Severity.NOTE) -> None:
        super().__init__()
        self.text = text
        self.severity = severity
