"""The order of packets by a column, judged by Python's own sort of what each packet alone says."""

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.addons.tui.data.sort import sort_order
from edoras_tools.addons.tui.data.store import PacketBlock, Store
from edoras_tools.decode.lines import line_of
from edoras_tools.pipelines.workbench import Settings, open_files

BENCH = Settings([ROOT / "samples/missions/two_rovers_ground.yaml"]).workbench()
WHOLE = next(iter(open_files([ROOT / "samples/captures/f_sbn_disconnect.pcap"]).batches()))
COLUMNS, COUNT = BENCH.columns.decode(WHOLE), 200
PACKETS = [BENCH.dissector.dissect(WHOLE[row]) for row in range(COUNT)]
KEYS = {
    "time": lambda item: item.datagram.time_ns,
    "ports": lambda item: (item.datagram.source.port, item.datagram.destination.port),
    "msg_id": lambda item: line_of(item).msg_id,
    "bytes": lambda item: len(item.datagram.payload),
    "topic": lambda item: line_of(item).name,
}


def store_of(sizes):
    """A store of the first packets, in blocks of these sizes."""
    store, first = Store(), 0
    for size in sizes:
        rows = slice(first, first + size)
        store.append(PacketBlock(WHOLE.take(rows), COLUMNS.take(rows)))
        first += size
    return store


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("column", KEYS)
@settings(max_examples=examples(5, part=2, least=2))
@given(sizes=st.lists(st.integers(1, 60), min_size=1, max_size=4).filter(lambda parts: sum(parts) <= COUNT))
def test_rows_are_in_the_order_of_their_values(column, reverse, sizes):
    store = store_of(sizes)
    order = sort_order(store.parts(), column, BENCH.columns.context, reverse=reverse)
    keys = [KEYS[column](item) for item in PACKETS[: sum(sizes)]]
    has = [row for row, key in enumerate(keys) if key not in ("", -1)]
    wanted = sorted(has, key=keys.__getitem__, reverse=reverse)
    assert order.tolist() == wanted + [row for row in range(len(keys)) if row not in set(has)]
    store.order = order
    for row in range(len(store)):
        assert store.find_number(int(WHOLE.number[store.place(row)])) == row
    assert (np.sort(order) == np.arange(len(store))).all()


def test_who_gives_up_gets_nothing():
    store = store_of([10])
    context = BENCH.columns.context
    assert sort_order(store.parts(), "time", context, reverse=False, given_up=lambda: True) is None
    assert len(sort_order([], "time", context, reverse=False)) == 0
