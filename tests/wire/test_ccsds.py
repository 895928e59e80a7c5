"""MsgIds of both versions, held to packets that a real cFS took or sent."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.wire import cfe
from edoras_tools.wire.ccsds import MSG_ID_BYTES, VERSION_1, VERSION_2

REAL = [
    # version, MsgId, first bytes of the packet: primary header and extended header
    (VERSION_1, 0x1806, "1806c0000009 00000000"),
    (VERSION_1, 0x0884, "0884c0010021 0c000042"),
    (VERSION_2, 0x1880, "1800c0000019 00180000"),
    (VERSION_2, 0x1884, "1804c0000009 00180000"),
    (VERSION_2, 0x18F0, "1870c0000009 00180000"),
    (VERSION_2, 0x0086, "1806c0000009 00000000"),
    (VERSION_2, 0x0804, "0804c0010021 0c080042"),
    (VERSION_2, 0x0800, "0800c001000d 0c080042"),
]
KNOWN = [
    *((0x1806, 0x0086), (0x0808, 0x0008), (0x1860, 0x00E0), (0x0860, 0x0060), (0x0800, 0x0000)),
    *(
        (0x1880, 0x1880),
        (0x1884, 0x1884),
        (0x18F0, 0x18F0),
        (0x18FA, 0x18FA),
        (0x0880, 0x0800),
        (0x0884, 0x0804),
    ),
]
"""The same packet in both versions: of services as in cFE's sample missions, of apps as in a real one."""
IDS = st.integers(0, 0xFFFF)


@pytest.mark.parametrize(("msg_ids", "msg_id", "raw"), REAL)
def test_packets_of_a_real_cfs(msg_ids, msg_id, raw):
    packet = bytes.fromhex(raw)
    assert msg_ids.of(packet) == msg_ids.of(b"xx" + packet, 2) == msg_id
    assert msg_ids.is_command(msg_id) == (packet[0] == 0x18)
    word, subsystem = msg_ids.words(msg_id)
    assert word.to_bytes(2, "big") == packet[:2]
    if msg_ids is VERSION_2:
        assert subsystem == packet[7]


@pytest.mark.parametrize(("first", "second"), KNOWN)
def test_what_is_known_of_cfe_has_other_numbers_in_version_2(first, second):
    assert VERSION_2.of_known(first) == second
    assert VERSION_1.of_known(first) == VERSION_1.standard(first) == first


@given(IDS)
def test_no_two_msg_ids_become_one(msg_id):
    known = VERSION_2.standard(msg_id)
    assert VERSION_2.of_known(known) == msg_id
    assert VERSION_1.is_command(known) == VERSION_2.is_command(msg_id)
    assert (known <= cfe.HIGHEST_MSG_ID) == (msg_id <= cfe.HIGHEST_MSG_ID)


@pytest.mark.parametrize("msg_ids", [VERSION_1, VERSION_2], ids=["1", "2"])
@given(packets=st.lists(st.binary(min_size=2, max_size=12), min_size=1, max_size=8))
def test_columns_are_read_as_one_packet_is(msg_ids, packets):
    """Bytes that are not there count as 0, whatever follows the packet in its buffer."""
    rows = [np.frombuffer(item.ljust(MSG_ID_BYTES, b"\xa5")[:MSG_ID_BYTES], np.uint8) for item in packets]
    found = msg_ids.column(np.stack(rows), np.array([len(item) for item in packets]))
    assert found.tolist() == [msg_ids.of(item) for item in packets]


def test_only_packets_with_such_headers_have_other_numbers():
    msg_id = np.array([0x0086, 0x1806, -1], np.int32)
    headers = np.array([cfe.HEADERS.index(cfe.WITH_EXTENDED_2), 0, 0], np.uint8)
    assert cfe.known_ids(msg_id, headers).tolist() == [0x1806, 0x1806, -1]
    assert cfe.known_ids(msg_id, headers * 0) is msg_id
