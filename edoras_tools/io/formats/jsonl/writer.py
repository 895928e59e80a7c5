"""Tables as JSON Lines."""

from __future__ import annotations

from json import dumps
from typing import IO, TYPE_CHECKING

from edoras_tools.io.formats.jsonl.texts import json_texts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.io.formats.columns import TableColumn, TableHead


class JsonLinesWriter:
    """Writes one object a row, its keys in the order of the columns; see ``TableWriter``."""

    def __init__(self, file: IO[bytes], _: TableHead, columns: Sequence[TableColumn]) -> None:
        self._file = file
        names = [dumps(column.name, ensure_ascii=False).replace("%", "%%") for column in columns]
        self._line = "{" + ", ".join(f"{name}: %s" for name in names) + "}\n"

    def write(self, columns: Sequence[TableColumn]) -> None:
        """Write some rows."""
        rows = zip(*map(json_texts, columns), strict=True)
        self._file.write("".join(map(self._line.__mod__, rows)).encode())

    def close(self) -> None:
        """Do nothing: every row is written."""
