"""Tables that are read while they are used."""

import pytest
from places import CAPTURES, MISSIONS

import edoras_tools


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
