import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.wire.arrays import by_value, numbered, order_by, perhaps_in, quantiles


@pytest.mark.parametrize("values", [[3, 1, 3, 2, 1], [70_000, 1, 70_000, 65_536 + 1, 1], [], [5]])
def test_order_by_puts_equal_keys_side_by_side_in_their_order(values):
    key = np.array(values, dtype=np.uint32)
    order = order_by(key)
    assert sorted(order.tolist()) == list(range(len(values)))
    ordered = key[order].tolist()
    assert [ordered.index(value) for value in ordered] == sorted(ordered.index(value) for value in ordered)
    assert len(set(values)) == sum(a != b for a, b in zip(ordered, [None, *ordered], strict=False))
    for value in set(values):
        places = order[key[order] == value].tolist()
        assert places == sorted(places)


@given(st.lists(st.integers(-(2**31), 2**31 - 1)), st.sampled_from(["i4", "i8"]))
def test_by_value_gives_every_row_once_under_its_value(values, dtype):
    groups = list(by_value(np.array(values, dtype)))
    assert [value for value, _ in groups] == sorted(set(values))
    for value, rows in groups:
        assert rows.tolist() == [index for index, item in enumerate(values) if item == value]


@given(st.data(), st.integers(0, 30))
def test_order_by_many_keys_puts_equal_rows_together_in_their_order(data, count):
    sizes = data.draw(st.lists(st.sampled_from([1, 2, 5, 255, 300, 70_000]), min_size=1, max_size=4))
    keys = [
        np.array(data.draw(st.lists(st.integers(0, size), min_size=count, max_size=count)), np.uint32)
        for size in sizes
    ]
    order = order_by(*keys)
    rows = list(zip(*(key[order].tolist() for key in keys), order.tolist(), strict=True))
    runs = [
        row[:-1]
        for before, row in zip([None, *rows], rows, strict=False)
        if before is None or row[:-1] != before[:-1]
    ]
    assert len(runs) == len(set(runs))
    assert sorted(order.tolist()) == list(range(count))
    for run in runs:
        places = [row[-1] for row in rows if row[:-1] == run]
        assert places == sorted(places)


@given(
    st.data(),
    st.integers(0, 40),
    st.sampled_from([("u1", 0, 255), ("i4", -5, 5), ("i8", -(2**63), 2**63 - 1), ("u8", 0, 2**64 - 1)]),
)
def test_numbered_gives_each_distinct_row_a_number_in_the_order_they_come(data, count, kind):
    dtype, low, high = kind
    drawn = st.lists(st.integers(low, high), min_size=count, max_size=count)
    keys = [np.array(data.draw(drawn), dtype) for _ in range(data.draw(st.integers(1, 3)))]
    first, which = numbered(*keys)
    rows = list(zip(*(key.tolist() for key in keys), strict=True))
    distinct = list(dict.fromkeys(rows))
    assert [rows[at] for at in first.tolist()] == distinct
    assert first.tolist() == [rows.index(row) for row in distinct]
    assert [distinct[number] for number in which.tolist()] == rows


def test_numbered_tells_values_apart_that_share_a_hash():
    values = np.arange(0, 1 << 62, 1 << 42)
    first, which = numbered(values)
    assert len(first) == len(values)
    assert which.tolist() == list(range(len(values)))


def test_numbered_numbers_very_many_values_by_one_hash_after_the_other():
    values = np.random.default_rng(1).integers(0, 1 << 63, 300_000, np.int64)[
        np.random.default_rng(2).integers(0, 300_000, 600_000)
    ]
    _, index, inverse = np.unique(values, return_index=True, return_inverse=True)
    first, which = numbered(values)
    assert (first == np.sort(index)).all()
    assert (first[which] == index[inverse]).all()


def test_perhaps_in_misses_no_equal_one_of_a_kind_that_fits_and_adds_few():
    random = np.random.default_rng(1)
    others, strange = random.integers(1, 1 << 63, (2, 5_000), np.int64).astype(np.uint64)
    kinds = (np.arange(len(others)) % 64).astype(np.uint8)
    fits = np.uint64(1) << kinds
    assert perhaps_in(others, others).all()
    assert perhaps_in(others, others, kinds, fits).all()
    assert perhaps_in(strange, others).mean() < 1 / 8
    assert perhaps_in(others, others, kinds, np.roll(fits, 1)).mean() < 1 / 8
    assert not perhaps_in(others, others[:0]).any()


@given(
    st.lists(st.integers(-(2**50), 2**50), min_size=1, max_size=60)
    | st.lists(st.floats(-1e9, 1e9), min_size=1, max_size=60),
    st.lists(st.sampled_from([0.0, 0.5, 0.9, 0.98, 0.99, 1.0]) | st.floats(0, 1), min_size=1, max_size=3),
)
def test_quantiles_are_those_of_numpy(values, shares):
    assert quantiles(np.array(values), *shares) == np.quantile(values, shares).tolist()
