"""A table with a column of every kind, and what is in it."""

from __future__ import annotations

import numpy as np

from edoras_tools.io.formats.columns import TableColumn, TableFile, TableHead
from edoras_tools.ros.cdr.bulk import Ragged

HEAD = TableHead("/all", "x/msg/All", {"edoras.definition": "float64 x"})
COLUMNS = (
    TableColumn("time", np.array([0, 1_795_241_600_123_456_789, 5], "datetime64[ns]")),
    TableColumn("ns", np.array([0, -1, 1 << 62]), unit="ns"),
    TableColumn("whole", np.array([0, 255, 7], np.uint8)),
    TableColumn("single", np.array([0.1, np.inf, np.nan], np.float32)),
    TableColumn("double", np.array([0.1, 1e300, -np.inf])),
    TableColumn("yes", np.array([True, False, True])),
    TableColumn("text", np.array(['a "b", c\n', "", "Ä €%s"], object)),
    TableColumn("fixed", np.arange(6, dtype=np.float64).reshape(3, 2)),
    TableColumn("list", Ragged(np.array([1, 2, 3], np.int16), np.array([0, 2, 2, 3]))),
    TableColumn("words", Ragged(np.array(["x", 'y"'], object), np.array([0, 0, 2, 2]))),
    TableColumn("a.b", np.array([1, 2, 3], np.int32), np.array([True, False, True])),
)
VALUES = {
    "ns": [0, -1, 1 << 62],
    "whole": [0, 255, 7],
    "double": [0.1, 1e300, -np.inf],
    "yes": [True, False, True],
    "text": ['a "b", c\n', "", "Ä €%s"],
    "fixed": [[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]],
    "list": [[1, 2], [], [3]],
    "words": [[], ["x", 'y"'], []],
    "a.b": [1, None, 3],
}


def written(path, make, *blocks):
    """Write blocks of columns as a file; return it."""
    table = TableFile(path, make, HEAD, blocks[0])
    for block in blocks:
        table.write(make.piece(block), len(block[0]))
    table.complete()
    table.keep()
    return table
