"""What is sought: by name, by bytes, by comparison; forwards and backwards, among what is shown."""

import numpy as np
import pytest
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from places import ROOT

from edoras_tools.addons.tui.store import PacketBlock, Store, matcher, next_number
from edoras_tools.pipelines.workbench import Settings, open_files

MISSIONS = [ROOT / f"samples/missions/two_rovers_{side}.yaml" for side in ("ground", "flight")]
BENCH = Settings(MISSIONS).workbench()
WHOLE = next(iter(open_files([ROOT / "samples/captures/f_sbn_disconnect.pcap"]).batches()))
COLUMNS = BENCH.columns.decode(WHOLE)


def found(text):
    return np.flatnonzero(matcher(text, BENCH.columns.context, 0)(PacketBlock(WHOLE, COLUMNS)))


@pytest.mark.parametrize(
    ("text", "like"),
    [
        ("/robot_1/cmd_vel", COLUMNS.msg_id == 0x82A),
        ("CMD_VEL", np.isin(COLUMNS.msg_id, [0x82A, 0x1827])),
        ("evs_long", COLUMNS.msg_id == 0x808),
        ("heartbeat", COLUMNS.sbn_msg_type == 0xA0),
        ("msg_id == 0x1829", COLUMNS.msg_id == 0x1829),
        ("0x1829", None),
        ("sequence_unset", (COLUMNS.findings & 16) != 0),
    ],
)
def test_names_and_comparisons(text, like):
    rows = found(text)
    if like is None:
        assert {WHOLE[row].payload.find(b"\x18\x29") >= 0 for row in rows} == {True}
    else:
        # The word may stand in the bytes of further packets.
        assert set(np.flatnonzero(like)) <= set(rows)
        rest = set(rows) - set(np.flatnonzero(like))
        assert all(text.lower().encode() in WHOLE[row].payload.lower() for row in rest)


@settings(max_examples=examples(25, 4))
@given(st.integers(0, len(WHOLE) - 1), st.data())
def test_bytes_are_found_in_the_packets_that_hold_them_and_in_no_other(row, data):
    payload = WHOLE[row].payload
    start = data.draw(st.integers(0, max(0, len(payload) - 1)))
    wanted = payload[start : start + data.draw(st.integers(1, 8))]
    if wanted:
        rows = found(f"0x{wanted.hex()}")
        assert rows.tolist() == [at for at in range(len(WHOLE)) if wanted in WHOLE[at].payload]


def test_next_goes_round_both_ways_among_what_is_shown():
    store = Store()
    for first in range(0, len(WHOLE), 500):
        rows = slice(first, first + 500)
        store.append(PacketBlock(WHOLE.take(rows), COLUMNS.take(rows)))
    seek = matcher("msg_id == 0x082a", BENCH.columns.context, 0)
    expected = WHOLE.number[COLUMNS.msg_id == 0x82A].tolist()
    parts = store.parts()
    numbers, row = [], 0
    for _ in range(len(expected) + 1):
        numbers.append(next_number(parts, seek, row))
        row = store.find_number(numbers[-1])
    assert numbers == [*expected, expected[0]]
    backwards = []
    for _ in expected:
        backwards.append(next_number(parts, seek, row, back=True))
        row = store.find_number(backwards[-1])
    assert backwards == [*reversed(expected[1:]), expected[0]]
    assert next_number(parts, matcher("no such thing", BENCH.columns.context, 0), 0) is None
    assert next_number([], seek, 0) is None
    assert next_number(parts, seek, 0, given_up=lambda: True) is None


@given(st.text(max_size=30))
def test_any_text_may_be_sought(text):
    seek = matcher(text, BENCH.columns.context, 0)
    assert len(seek(PacketBlock(WHOLE.take(slice(0, 50)), COLUMNS.take(slice(0, 50))))) == 50
