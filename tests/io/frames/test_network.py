from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from edoras_tools.io.frames.network import QUOTED_BYTES, Fragment, Reassembler

KEY = (4, 7, b"\x7f\0\0\1", b"\x7f\0\0\2")
SECOND = 1_000_000_000


def pieces_of(payload, size, key=KEY, time_ns=0):
    starts = range(0, len(payload), size)
    return [
        Fragment(key, time_ns, start, start + size < len(payload), True, payload[start : start + size])
        for start in starts
    ]


@given(
    payload=st.binary(min_size=9, max_size=400),
    size=st.sampled_from([8, 16, 64]),
    data=st.data(),
)
def test_any_order_with_duplicates(payload, size, data):
    pieces = pieces_of(payload, size)
    order = data.draw(st.permutations(pieces)) if len(pieces) < 12 else pieces[::-1]
    reassembler = Reassembler()
    for piece in order[:-1]:
        assert reassembler.add(piece)[0] is None
        assert reassembler.add(piece)[0] is None
    assert reassembler.add(order[-1])[0] == payload
    assert reassembler.pending == 0
    assert reassembler.abandoned == 0


def test_ports_are_known_from_the_first_fragment_on():
    first, second, third = pieces_of(b"\x12\x34\x56\x78" + bytes(20), 8)
    reassembler = Reassembler()
    assert reassembler.add(second) == (None, (0, 0))
    assert reassembler.add(first) == (None, (0x1234, 0x5678))
    assert reassembler.add(third)[1] == (0x1234, 0x5678)


def test_the_beginning_of_what_never_became_whole_is_kept():
    first, *_ = pieces_of(b"\x12\x34\x56\x78" + bytes(200), 104)
    *_, last = pieces_of(bytes(200), 104, key=(4, 8, *KEY[2:]))
    more = pieces_of(bytes(300), 104, key=(4, 6, *KEY[2:]))
    reassembler = Reassembler(timeout_ns=SECOND)
    assert reassembler.add(first)[0] is None
    assert reassembler.add(last)[0] is None
    assert [reassembler.add(piece)[0] for piece in more[:2]] == [None, None]  # later ones come through
    cut, *_ = pieces_of(bytes(200), 104, key=(4, 5, *KEY[2:]))
    assert reassembler.add(replace(cut, whole=False))[0] is None  # the capture cut it, not the network
    whole = pieces_of(bytes(200), 104, key=(4, 4, *KEY[2:]))
    assert [reassembler.add(piece)[0] for piece in (*whole, whole[-1])] == [None, bytes(200), None]  # doubled
    heads = [item.head for item in reassembler.beginnings()]
    assert heads == [first.data[:QUOTED_BYTES], b"", b""]  # of the others nobody knows what they were
    for piece in pieces_of(bytes(200), 104, key=(4, 9, *KEY[2:]), time_ns=3 * SECOND):
        reassembler.add(piece)
    assert (reassembler.pending, reassembler.abandoned) == (0, 5)
    assert {(item.time_ns, item.source, item.destination) for item in reassembler.beginnings()} == {
        (0, KEY[2], KEY[3])
    }
    assert [item.head for item in reassembler.beginnings()] == heads


def test_what_lacks_fragments_is_kept_where_its_identification_came_before():
    reassembler = Reassembler(timeout_ns=SECOND)
    for at in range(100):
        for piece in pieces_of(bytes(200), 104, time_ns=at * SECOND // 20):
            reassembler.add(piece)
    assert reassembler.beginnings() == []
    first, _ = pieces_of(bytes(200), 104, time_ns=9 * SECOND)
    assert reassembler.add(first)[0] is None
    assert [item.time_ns for item in reassembler.beginnings()] == [9 * SECOND]


def test_the_first_to_arrive_stays_where_fragments_overlap():
    reassembler = Reassembler()
    reassembler.add(Fragment(KEY, 0, 8, True, True, b"B" * 8))
    reassembler.add(Fragment(KEY, 0, 0, True, True, b"A" * 16))
    assert reassembler.add(Fragment(KEY, 0, 16, False, True, b"C"))[0] == b"A" * 8 + b"B" * 8 + b"C"


@pytest.mark.parametrize(
    "bad",
    [
        Fragment(KEY, 0, 8, True, True, b"odd"),
        Fragment(KEY, 0, 16, False, True, b"another end"),
        Fragment(KEY, 0, 24, True, True, bytes(8)),
        Fragment(KEY, 0, 65528, False, True, bytes(100)),
        Fragment(KEY, 0, 0, True, False, bytes(8)),
        Fragment(KEY, 0, 0, True, True, b""),
    ],
)
def test_a_fragment_that_contradicts_is_left_out(bad):
    reassembler = Reassembler()
    reassembler.add(Fragment(KEY, 0, 8, False, True, b"B" * 16))
    assert reassembler.add(bad)[0] is None
    assert reassembler.add(Fragment(KEY, 0, 0, True, True, b"A" * 8))[0] == b"A" * 8 + b"B" * 16


def test_datagrams_do_not_mix():
    reassembler = Reassembler()
    other = (*KEY[:1], 8, *KEY[2:])
    first, last = pieces_of(b"x" * 16, 8)
    first_of_other, last_of_other = pieces_of(b"y" * 16, 8, other)
    assert reassembler.add(first)[0] is None
    assert reassembler.add(last_of_other)[0] is None
    assert reassembler.add(first_of_other)[0] == b"y" * 16
    assert reassembler.add(last)[0] == b"x" * 16


def test_time_is_bounded():
    reassembler = Reassembler(timeout_ns=30 * SECOND)
    first, last = pieces_of(b"x" * 16, 8)
    reassembler.add(first)
    late = Fragment(KEY, 31 * SECOND, last.start, last.more, last.whole, last.data)
    assert reassembler.add(late)[0] is None
    assert (reassembler.abandoned, reassembler.pending) == (1, 1)


def test_room_is_bounded():
    reassembler = Reassembler(limit=10_000)
    for number in range(1000):
        reassembler.add(Fragment((4, number, *KEY[2:]), 0, 8, True, True, bytes(800)))
    assert reassembler.pending <= 10
    assert reassembler.pending + reassembler.abandoned == 1000


@given(
    st.lists(
        st.builds(
            Fragment,
            st.just(KEY),
            st.integers(0, 40 * SECOND),
            st.integers(0, 8191).map(lambda unit: unit * 8) | st.sampled_from([0, 8, 16]),
            st.booleans(),
            st.booleans(),
            st.binary(max_size=24),
        ),
        max_size=30,
    )
)
def test_garbage_never_raises_and_never_gives_more_than_ip_can_carry(fragments):
    reassembler = Reassembler(limit=500)
    for fragment in fragments:
        payload, _ = reassembler.add(fragment)
        assert payload is None or len(payload) <= 65535
