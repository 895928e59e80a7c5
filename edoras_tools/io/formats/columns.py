"""Tables that are written column by column, to files that appear only when they are complete."""

from __future__ import annotations

from contextlib import contextmanager
from typing import IO, TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np

from edoras_tools.errors import CaptureError
from edoras_tools.io.outputs import NewFile
from edoras_tools.ros.cdr.columns import Ragged

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from edoras_tools.wire.arrays.order import Integers, Mask


class TableColumn(msgspec.Struct, frozen=True):
    """A column of a table.

    Attributes:
        name: unique in its table.
        values: one element per row: numbers, bool, ``datetime64[ns]`` (UTC), or ``object`` for texts; of
            shape (rows, elements) or ``Ragged`` if a row contains a list.
        present: bool, the rows that have a value; None for all.
        unit: of the numbers, e.g. ``ns``; empty if unknown.
    """

    name: str
    values: NDArray[Any] | Ragged
    present: Mask | None = None
    unit: str = ""

    def __len__(self) -> int:
        return len(self.values)

    def spread(self) -> tuple[NDArray[Any], Integers | None]:
        """Return all values in one array, and the start of each row's list in it.

        Returns:
            The values, and one offset more than rows; None if no row contains a list.
        """
        if isinstance(self.values, Ragged):
            return self.values.values, self.values.offsets
        if self.values.ndim == 1:
            return self.values, None
        rows, width = self.values.shape
        return self.values.reshape(-1), np.arange(rows + 1, dtype=np.int64) * width


class TableHead(msgspec.Struct, frozen=True):
    """The description of a table, for formats that store one.

    Attributes:
        topic: topic of the messages.
        type: ROS type of the messages.
        metadata: texts by name, such as the definition of the type.
    """

    topic: str
    type: str
    metadata: Mapping[str, str] = msgspec.field(default_factory=dict)


class TableWriter(Protocol):
    """Writes a table of rows that have the same columns.

    All methods raise the errors of the file and the library; ``TableFile`` turns them into ``CaptureError``.
    """

    def __init__(self, file: IO[bytes], head: TableHead, columns: Sequence[TableColumn]) -> None:
        """Start a table; ``columns`` may have no rows."""

    @staticmethod
    def piece(columns: Sequence[TableColumn]) -> Any:
        """Return some rows in the form that ``write`` takes; callable in any process, and long before."""

    def write(self, piece: Any) -> None:
        """Write some rows; their columns may change afterwards."""

    def close(self) -> None:
        """Write the remaining rows and complete the table; the file stays open."""


class TableFile:
    """A table in a file that appears under its name when it is complete.

    If the table cannot be finished, the incomplete file is removed, and an existing file stays unchanged
    (``outputs.NewFile``). A pipe or device is written directly.

    Args:
        make: makes the writer of the format.
        columns: see ``TableWriter``.

    Attributes:
        path: path of the file.
        head: description of the table.
        rows: number of rows written.

    Raises:
        CaptureError: from all methods: the file cannot be written.
    """

    def __init__(
        self, path: Path, make: Callable[..., TableWriter], head: TableHead, columns: Sequence[TableColumn]
    ) -> None:
        self.path, self.head, self.rows = path, head, 0
        try:
            self._new = NewFile(path)
        except OSError as error:
            raise self._failure(error) from error
        with self._removed_on_failure():
            self._writer = make(self._new.file, head, columns)

    def write(self, piece: Any, rows: int) -> None:
        """Write some rows."""
        with self._removed_on_failure():
            self._writer.write(piece)
        self.rows += rows

    def complete(self) -> None:
        """Write the rest of the table."""
        with self._removed_on_failure():
            self._writer.close()
            self._new.file.flush()

    def keep(self) -> None:
        """Close the file, and give it its name."""
        with self._removed_on_failure():
            self._new.keep()

    def remove(self) -> None:
        """Close the file, and remove it if it is incomplete."""
        self._new.remove()

    @contextmanager
    def _removed_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as error:
            self.remove()
            if isinstance(error, OSError):
                raise self._failure(error) from error
            raise

    def _failure(self, error: OSError) -> CaptureError:
        return CaptureError(f"{self.path}: cannot be written: {error.strerror or error}")
