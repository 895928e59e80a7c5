"""Blocks are found by row and number, filtered in order, put together and let go; no packet changes."""

from __future__ import annotations

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.addons.tui.store import PacketBlock, Store, join_blocks, sort_order
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.lines import line_of
from edoras_tools.model import Columns
from edoras_tools.pipelines.capture.record import compact
from edoras_tools.pipelines.workbench import Settings, open_files

BENCH = Settings([ROOT / "samples/missions/two_rovers_ground.yaml"]).workbench()
WHOLE = next(iter(open_files([ROOT / "samples/captures/f_sbn_disconnect.pcap"]).batches()))
COLUMNS = BENCH.columns.decode(WHOLE)
COUNT = 200


def block(first, last):
    rows = slice(first, last)
    return PacketBlock(WHOLE.take(rows), COLUMNS.take(rows))


def cut(sizes):
    """Blocks of these sizes, one after the other."""
    ends = np.cumsum(sizes)
    return [block(end - size, end) for size, end in zip(sizes, ends, strict=True)]


sizes = st.lists(st.integers(1, 60), min_size=1, max_size=12)


@given(sizes)
def test_a_row_is_the_same_packet_however_blocks_are_cut_and_joined(parts):
    store = Store()
    for item in cut(parts):
        store.append(item)
    assert len(store) == store.packets == sum(parts)
    for row in range(0, len(store), 7):
        assert store.datagram(row) == WHOLE[row]
        assert store.find_number(int(WHOLE.number[row])) == row
        found, index = store.locate(row)
        for name in Columns.__struct_fields__:
            value = getattr(found.columns, name)[index]
            wanted = getattr(COLUMNS, name)[row]
            if name in {"packet_offset", "cdr_offset"} and wanted >= 0:
                value, wanted = value - found.batch.offset[index], wanted - WHOLE.offset[row]
            assert value == wanted, name


@given(sizes, st.randoms(use_true_random=False))
def test_a_filter_settles_in_order_whichever_answers_first(parts, chance):
    store, where = Store(), Where("msg_id == 0x0808 or link == sbn", BENCH.columns.context)
    store.restart(filtered=True)
    blocks = cut(parts)
    for item in blocks:
        store.append(item)
    chance.shuffle(blocks)
    expected = np.flatnonzero(where.mask(WHOLE, COLUMNS))
    expected = expected[expected < sum(parts)].tolist()
    for item in blocks:
        store.settle(item, np.flatnonzero(where.mask(item.batch, item.columns)))
        shown = [store.datagram(row).number for row in range(len(store))]
        assert shown == [int(WHOLE.number[row]) for row in expected[: len(shown)]]
    assert len(store) == len(expected)
    store.restart(filtered=False)
    assert len(store) == sum(parts)


def test_small_blocks_are_put_together():
    store = Store()
    for row in range(COUNT):
        store.append(block(row, row + 1))
    assert len(store.blocks) < 12
    assert [store.datagram(row) for row in range(COUNT)] == [WHOLE[row] for row in range(COUNT)]


@given(sizes)
def test_the_oldest_go_when_there_is_no_room(parts):
    store = Store(limit=30_000)
    gone = sum(store.append(PacketBlock(*compact(item.batch, item.columns))) for item in cut(parts))
    assert gone == store.forgotten
    assert store.packets + gone == sum(parts)
    assert len(store) == store.packets >= 1
    assert store.datagram(0) == WHOLE[gone]
    assert len(store.blocks) == 1 or store.size <= 30_000


def test_an_empty_block_is_no_block():
    store = Store()
    assert store.append(block(3, 3)) == 0
    assert (len(store), store.blocks, store.begin_ns) == (0, [], None)
    assert store.find_number(1) is None


def test_compact_leaves_every_packet_as_it_is():
    rows = np.arange(5, 1500, 97)
    batch, columns = WHOLE.take(rows), COLUMNS.take(rows)
    small, moved = compact(batch, columns)
    assert len(small.data) < len(batch.data) // 10
    assert [small[index] for index in range(len(rows))] == [batch[index] for index in range(len(rows))]
    assert (moved.packet_offset - small.offset)[columns.packet_offset >= 0].tolist() == (
        columns.packet_offset - batch.offset
    )[columns.packet_offset >= 0].tolist()
    whole = join_blocks(
        PacketBlock(small, moved, range(len(rows))), PacketBlock(small, moved, range(len(rows)))
    )
    assert whole.batch[len(rows)] == small[0]
    again = BENCH.columns.decode(whole.batch)
    assert (again.cdr_offset == whole.columns.cdr_offset).all()


def test_a_payload_that_lies_behind_its_frame_is_kept():
    from msgspec.structs import replace

    # As one that was put together from fragments: its bytes are elsewhere in the buffer.
    payload = WHOLE[187].payload
    data = np.concatenate([WHOLE.data, np.frombuffer(payload, np.uint8)])
    apart = replace(WHOLE.take(slice(187, 188)), data=data, offset=np.array([len(WHOLE.data)]))
    small, _ = compact(apart, BENCH.columns.decode(apart))
    assert len(small.data) < 1000
    assert small[0].payload == payload
    assert small[0].payload_offset == -1


SORT_COLUMNS, SORT_COUNT = BENCH.columns.decode(WHOLE), 200
PACKETS = [BENCH.dissector.dissect(WHOLE[row]) for row in range(SORT_COUNT)]
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
        store.append(PacketBlock(WHOLE.take(rows), SORT_COLUMNS.take(rows)))
        first += size
    return store


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("column", KEYS)
@settings(max_examples=examples(5, part=2, least=2))
@given(
    sizes=st.lists(st.integers(1, 60), min_size=1, max_size=4).filter(lambda parts: sum(parts) <= SORT_COUNT)
)
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
