import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import FieldError, TruncatedError
from edoras_tools.links import bare
from edoras_tools.wire import ccsds, cfe, envelope, sbn, transfer_frames
from edoras_tools.wire.layout import Field, Layout

LAYOUTS = [
    ccsds.PRIMARY,
    cfe.COMMAND,
    cfe.TELEMETRY,
    cfe.TELEMETRY_SHORT,
    cfe.EXTENDED,
    cfe.EVENT,
    cfe.SOFTWARE_BUS_HOUSEKEEPING,
    cfe.COMMAND_INGEST_HOUSEKEEPING,
    cfe.COMMAND_INGEST_HOUSEKEEPING_7,
    cfe.TELEMETRY_OUTPUT_HOUSEKEEPING,
    sbn.HEADER,
    sbn.LEGACY_HEADER,
    sbn.SUBSCRIPTIONS,
    sbn.SUBSCRIPTION,
    sbn.PROTO,
    envelope.ENCAPSULATION,
    *(item.layout for item in envelope.ENVELOPE_FORMATS),
    *bare.SENT_TO,
    transfer_frames.TM,
    transfer_frames.TM_SECONDARY,
    transfer_frames.AOS,
    transfer_frames.AOS_PACKETS,
    transfer_frames.TC,
    transfer_frames.TC_SEGMENT,
    Layout(
        "reversed", "Three bytes", Field("a", 24, ""), Field("b", 24, "", kind="int"), byte_order="little"
    ),
]
SIZES = [
    6,
    2,
    10,
    6,
    4,
    156,
    28,
    24,
    12,
    4,
    11,
    7,
    50,
    6,
    1,
    4,
    16,
    16,
    8,
    8,
    4,
    4,
    2,
    48,
    56,
    64,
    6,
    1,
    6,
    2,
    5,
    1,
    6,
]


@pytest.mark.parametrize(("layout", "size"), list(zip(LAYOUTS, SIZES, strict=True)))
def test_sizes_are_those_on_the_wire(layout, size):
    assert layout.size == size
    assert sum(slot.field.bits for slot in layout.slots) == 8 * size


@pytest.mark.each(3)
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
@given(data=st.data())
def test_columns_and_scalar_reader_agree_on_any_bytes(layout, data):
    raw = data.draw(st.binary(min_size=layout.size, max_size=layout.size))
    window = np.frombuffer(raw + b"\xa5" * 3, np.uint8)[None]
    values = layout.parse(raw)
    for name, column in layout.columns(window).items():
        assert column[0] == values[name] or values[name] != values[name], name  # equal, or both NaN


@pytest.mark.each(3)
@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
@given(data=st.data())
def test_what_is_read_is_written_again(layout, data):
    raw = data.draw(st.binary(min_size=layout.size, max_size=layout.size))
    values = layout.parse(raw)
    texts = [slot for slot in layout.slots if slot.field.kind == "text"]
    again = layout.parse(layout.emit({k: v for k, v in values.items() if "�" not in str(v)}))
    for name, value in values.items():
        if "�" not in str(value):
            assert again[name] == value
    if not texts:
        assert layout.emit(values) == raw


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_every_truncation_says_where_and_how_much(layout):
    for have in range(layout.size):
        with pytest.raises(TruncatedError) as caught:
            layout.parse(bytes(3 + have), 3)
        assert (caught.value.layer, caught.value.offset) == (layout.name, 3)
        assert (caught.value.need, caught.value.have) == (layout.size, have)


def test_a_value_that_does_not_fit_is_named():
    with pytest.raises(FieldError, match=r"ccsds.apid: 2048 exceeds 11 bits \(0 to 2047\)"):
        ccsds.PRIMARY.emit({"apid": 2048})
    with pytest.raises(FieldError, match="no such field"):
        ccsds.PRIMARY.emit({"seq": 1})
    with pytest.raises(FieldError, match=r"sbn.msg_size: 40000 exceeds 16 bits \(-32768 to 32767\)"):
        sbn.HEADER.emit({"msg_size": 40000})
    with pytest.raises(FieldError, match="21 bytes exceed 20"):
        cfe.EVENT.emit({"app_name": "x" * 21})


def test_fields_never_spill_into_their_neighbours():
    names = [slot.field.name for slot in ccsds.PRIMARY.slots]
    for name in names:
        mask = ccsds.PRIMARY.by_name[name].mask
        assert ccsds.PRIMARY.parse(ccsds.PRIMARY.emit({name: mask})) == {
            other: mask if other == name else 0 for other in names
        }


def test_text_tells_names_and_bases():
    by_name = ccsds.PRIMARY.by_name
    assert by_name["apid"].field.text(0x27) == "0x027"
    assert by_name["packet_type"].field.text(1) == "telecommand (1)"
    assert by_name["packet_data_length"].field.text(69) == "69"


def test_bit_fields_are_refused_where_they_have_no_meaning():
    with pytest.raises(ValueError, match="whole bytes only"):
        Layout("x", "x", Field("a", 4, ""), Field("b", 4, ""), byte_order="little")
    with pytest.raises(ValueError, match="no whole number of bytes"):
        Layout("x", "x", Field("a", 3, ""))
