"""Tables as JSON Lines."""

from __future__ import annotations

from json import dumps
from typing import IO, TYPE_CHECKING

import numpy as np

from edoras_tools.io.formats.jsonl.texts import json_texts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.io.formats.columns import TableColumn, TableHead


class JsonLinesWriter:
    """Writes one object a row, its keys in the order of the columns; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], _: TableHead, __: Sequence[TableColumn]) -> None:
        self._file = file

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> NDArray[np.uint8]:
        """Return some rows as text."""
        names = [dumps(column.name, ensure_ascii=False).replace("%", "%%") for column in columns]
        line = "{" + ", ".join(f"{name}: %s" for name in names) + "}\n"
        rows = zip(*map(json_texts, columns), strict=True)
        return np.frombuffer("".join(map(line.__mod__, rows)).encode(), np.uint8)

    def write(self, piece: NDArray[np.uint8]) -> None:
        """Write some rows."""
        self._file.write(piece.data)

    def close(self) -> None:
        """Do nothing: every row is written."""
