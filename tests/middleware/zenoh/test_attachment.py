import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh import ZBytes
from zenoh.ext import Int64, z_deserialize, z_serialize

from edoras_tools.errors import FieldError, TruncatedError, WireError
from edoras_tools.middleware.zenoh.attachment import Attachment

CASES = [
    (Attachment(1, 0, bytes(16)), "01" + "00" * 15 + "10" + "00" * 16),
    (
        Attachment(258, 0x17979C15C9C0CD15, bytes(range(16))),
        "0201000000000000 15cdc0c9159c9717 10 000102030405060708090a0b0c0d0e0f",
    ),
    (Attachment(-1, -2, b"\xff" * 16), "ff" * 8 + "fe" + "ff" * 7 + "10" + "ff" * 16),
]
NUMBERS = st.integers(-(2**63), 2**63 - 1)
ATTACHMENTS = st.builds(Attachment, NUMBERS, NUMBERS, st.binary(min_size=16, max_size=16))


@pytest.mark.parametrize(("attachment", "raw"), CASES)
def test_cases_both_ways(attachment, raw):
    assert attachment.emit() == bytes.fromhex(raw)
    assert Attachment.parse(bytes.fromhex(raw)) == attachment


@given(ATTACHMENTS)
def test_what_is_written_is_read(attachment):
    raw = attachment.emit()
    assert len(raw) == 33
    assert Attachment.parse(raw) == attachment


@given(ATTACHMENTS)
def test_zenohs_own_serializer_writes_and_reads_the_same(attachment):
    number, time = attachment.sequence_number, attachment.source_timestamp
    theirs = z_serialize((Int64(number), Int64(time), attachment.source_gid))
    assert theirs.to_bytes() == attachment.emit()
    read = z_deserialize(tuple[Int64, Int64, bytes], ZBytes(attachment.emit()))
    assert read == (number, time, attachment.source_gid)


@given(st.binary(max_size=70))
def test_any_bytes_are_an_attachment_or_a_wire_error(raw):
    try:
        attachment = Attachment.parse(raw)
    except WireError:
        return
    assert attachment.emit() == raw


@pytest.mark.parametrize(
    ("raw", "error", "words"),
    [
        (bytes(32), TruncatedError, "attachment at byte 0 needs 33 bytes, 32 are there"),
        (bytes(33), FieldError, "source_gid: 0 bytes are announced"),
        (Attachment(1, 2, bytes(16)).emit() + b"x", WireError, "1 bytes follow"),
    ],
)
def test_mistakes_are_told(raw, error, words):
    with pytest.raises(error, match=words):
        Attachment.parse(raw)


@pytest.mark.parametrize(
    ("attachment", "field"),
    [
        (Attachment(2**63, 0, bytes(16)), "sequence_number"),
        (Attachment(0, -(2**63) - 1, bytes(16)), "source_timestamp"),
        (Attachment(0, 0, bytes(15)), "source_gid"),
    ],
)
def test_what_does_not_fit_is_not_written(attachment, field):
    with pytest.raises(FieldError, match=field):
        attachment.emit()
