"""Parquet and Arrow files as pyarrow reads them, and tables that are read while they are used.

``pipelines/export`` asks other readers.
"""

import subprocess
import sys

import numpy as np
import pytest
from places import CAPTURES, MISSIONS, SUPPORT
from tables import COLUMNS, VALUES, written

import edoras_tools

pa = pytest.importorskip("pyarrow")
parquet = pytest.importorskip("pyarrow.parquet")


def read_arrow(path):
    with pa.ipc.open_file(path) as file:
        return file.read_all()


@pytest.mark.parametrize(
    ("name", "read"), [("ParquetWriter", parquet.read_table), ("ArrowWriter", read_arrow)]
)
def test_every_kind_of_column(tmp_path, name, read):
    from edoras_tools.addons.tables import arrow

    path = tmp_path / "a"
    written(path, getattr(arrow, name), COLUMNS, COLUMNS)
    table = read(path)
    assert table.num_rows == 6
    equal = table.drop_columns(["single"])  # NaN equals nothing
    assert equal.slice(0, 3).equals(equal.slice(3), check_metadata=True)
    for column, values in VALUES.items():
        assert table.column(column).to_pylist()[:3] == values
    assert table.column("time").cast(pa.int64()).to_pylist()[1] == 1_795_241_600_123_456_789
    assert np.isnan(table.column("single")[2].as_py())
    types = {field.name: str(field.type) for field in table.schema}
    assert types == {
        "time": "timestamp[ns, tz=UTC]",
        "ns": "int64",
        "whole": "uint8",
        "single": "float",
        "double": "double",
        "yes": "bool",
        "text": "string",
        "fixed": types["fixed"],
        "list": types["list"],
        "words": types["words"],
        "a.b": "int32",
    }
    lists = [table.schema.field(column).type.value_type for column in ("fixed", "list", "words")]
    assert list(map(str, lists)) == ["double", "int16", "string"]
    assert table.schema.field("ns").metadata[b"unit"] == b"ns"
    told = {key: value for key, value in table.schema.metadata.items() if key.startswith(b"edoras")}
    assert told == {
        b"edoras.topic": b"/all",
        b"edoras.type": b"x/msg/All",
        b"edoras.definition": b"float64 x",
    }


def test_writing_does_not_import_pandas():
    """It takes half a second, which a short export is not worth."""
    code = """
import sys, io
from tables import COLUMNS, HEAD
from edoras_tools.addons.tables.arrow import ParquetWriter
writer = ParquetWriter(io.BytesIO(), HEAD, COLUMNS)
writer.write(writer.piece(COLUMNS))
writer.close()
assert "pandas" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=SUPPORT, timeout=300)


@pytest.fixture(scope="module")
def table():
    return edoras_tools.read(CAPTURES / "a_rover.pcap", config=MISSIONS / "rover_ground.yaml")["/cmd_vel"]


def test_polars(table):
    polars = pytest.importorskip("polars")
    frame = table.to_polars(lazy=True)
    fast = frame.filter(polars.col("linear.x") > 0.5).select("time", "linear.x")
    whole = table.to_polars()
    assert "columns" in vars(table), "only what is used whole is kept"
    assert fast.collect().equals(whole.filter(polars.col("linear.x") > 0.5).select("time", "linear.x"))
    assert frame.head(3).collect().equals(whole.head(3))
    assert frame.collect().equals(frame.collect()), "it can be collected again"
    assert frame.collect_schema() == whole.schema


def test_arrow(table):
    dataset = pytest.importorskip("pyarrow.dataset")
    whole = table.to_arrow()
    reader = table.to_arrow(lazy=True)
    assert reader.schema.equals(whole.schema, check_metadata=True)
    scanner = dataset.Scanner.from_batches(
        reader, filter=dataset.field("linear.x") > 0.5, columns=["linear.x"]
    )
    assert scanner.count_rows() == 314
    assert table.to_arrow(lazy=True).read_all().equals(whole)


def test_nothing_is_read_before_it_is_asked_for(table):
    other = edoras_tools.read(CAPTURES / "a_rover.pcap", config=MISSIONS / "rover_ground.yaml")["/cmd_vel"]
    reader = other.to_arrow(lazy=True)
    assert len(next(iter(reader))) == 0
    assert "columns" not in vars(other)
    assert sum(map(len, reader)) == len(table)
