"""The headers in both directions: TM against `spacepackets`; AOS and TC from bytes by the standard."""

import pytest
from spacepackets.ccsds import tm_frame

from edoras_tools.wire.transfer_frames import headers

AOS = {
    "transfer_frame_version_number": 1,
    "spacecraft_id": 0xA5,
    "virtual_channel_id": 0x2A,
    "virtual_channel_frame_count": 0x123456,
    "replay_flag": 1,
    "frame_count_usage_flag": 0,
    "spacecraft_id_high": 2,
    "frame_count_cycle": 9,
}
TC = {
    "transfer_frame_version_number": 0,
    "bypass_flag": 1,
    "control_command_flag": 0,
    "reserved": 0,
    "spacecraft_id": 0x3FE,
    "virtual_channel_id": 0x21,
    "frame_length": 0x2AB,
    "frame_sequence_number": 0xCD,
}


@pytest.mark.parametrize(
    ("layout", "raw", "values"),
    [
        (headers.AOS, "696a123456a9", AOS),
        (headers.AOS_PACKETS, "07fe", {"reserved": 0, "first_header_pointer": headers.ONLY_IDLE_DATA}),
        (headers.TC, "23fe86abcd", TC),
        (headers.TC_SEGMENT, "c5", {"segment_sequence_flags": 3, "map_id": 5}),
        (headers.TM_SECONDARY, "05", {"version_number": 0, "secondary_header_length": 5}),
    ],
)
def test_both_directions(layout, raw, values):
    assert layout.parse(bytes.fromhex(raw)) == values
    assert layout.emit(values).hex() == raw
    assert layout.size == len(raw) // 2


def test_tm_as_an_independent_package_writes_it():
    status = tm_frame.TransferFrameDataFieldStatus(True, False, False, 3, 0x5A5)
    head = tm_frame.TmFramePrimaryHeader(tm_frame.MasterChannelId(0, 0x2BC), 6, True, 0xE1, 0x17, status)
    values = {
        "transfer_frame_version_number": 0,
        "spacecraft_id": 0x2BC,
        "virtual_channel_id": 6,
        "ocf_flag": 1,
        "master_channel_frame_count": 0xE1,
        "virtual_channel_frame_count": 0x17,
        "secondary_header_flag": 1,
        "synchronization_flag": 0,
        "packet_order_flag": 0,
        "segment_length_id": 3,
        "first_header_pointer": 0x5A5,
    }
    assert headers.TM.parse(head.pack()) == values
    assert headers.TM.emit(values) == head.pack()
