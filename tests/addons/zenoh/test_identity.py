"""Keys and tokens as the design has them, the hash as its reference, attachments as Zenoh's own."""

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh import ZBytes
from zenoh.ext import Int64, z_deserialize, z_serialize

from edoras_tools.addons.zenoh.identity import (
    Attachment,
    KeyedTopic,
    NodeTokens,
    TokenKind,
    depth,
    gid,
    qos_text,
    xxh3,
)
from edoras_tools.errors import ConfigError, FieldError, TruncatedError, WireError
from edoras_tools.middleware import Qos
from edoras_tools.middleware.names import check_name, node_name

HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = KeyedTopic("/chatter", "std_msgs/msg/String", HASH)


@pytest.mark.parametrize(
    ("topic", "domain", "key"),
    [
        (CHATTER, 0, f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"),
        (
            CHATTER._replace(name="/robot1/chatter"),
            0,
            f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}",
        ),
        (
            KeyedTopic("/cmd_vel", "geometry_msgs/msg/Twist", "TypeHashNotSupported"),
            42,
            "42/cmd_vel/geometry_msgs::msg::dds_::Twist_/TypeHashNotSupported",
        ),
    ],
)
def test_keys_as_the_design_has_them(topic, domain, key):
    assert topic.key(domain) == key


def test_tokens_as_the_design_has_them():
    node = NodeTokens.of_node("listener", 2, "aac3178e146ba6f1fc6e6a4085e77f21")
    assert node.token == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert node.entity_token(TokenKind.SUBSCRIPTION, 10, CHATTER, Qos()) == (
        "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/"
        f"std_msgs::msg::dds_::String_/{HASH}/::,10:,:,:,,"
    )
    talker = NodeTokens.of_node("talker", 2, "8b20917502ee955ac4476e0266340d5c")
    assert talker.entity_token(TokenKind.PUBLISHER, 10, CHATTER, Qos(depth=7)) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
    )


def test_a_namespace_is_one_chunk():
    node = NodeTokens.of_node("/arm/left/bridge", 0, "ab")
    assert node.token == "@ros2_lv/0/ab/0/0/NN/%/%arm%left/bridge"


@pytest.mark.parametrize(
    ("qos", "text"),
    [
        (Qos(), "::,10:,:,:,,"),
        (Qos(depth=42), "::,:,:,:,,"),
        (Qos(reliable=False, depth=5), "2::,5:,:,:,,"),
        (Qos(transient_local=True, depth=1), ":1:,1:,:,:,,"),
        (Qos(depth=0), "::2,:,:,:,,"),
        (Qos(reliable=False, transient_local=True, depth=0), "2:1:2,:,:,:,,"),
    ],
)
def test_qos_leaves_out_what_is_usual(qos, text):
    assert qos_text(qos) == text


def read_qos(text):
    """Read a quality of service as rmw_zenoh does: six parts, nothing for a default."""
    reliability, durability, history, deadline, lifespan, liveliness = text.split(":")
    kind, size = history.split(",")
    assert (deadline, lifespan, liveliness) == (",", ",", ",,")
    return {"": True, "1": True, "2": False}[reliability], durability == "1", kind == "2", int(size or 42)


@given(st.builds(Qos, st.booleans(), st.booleans(), st.integers(0, 10_000)))
def test_qos_is_read_back(qos):
    assert read_qos(qos_text(qos)) == (qos.reliable, qos.transient_local, qos.depth == 0, depth(qos))


@pytest.mark.parametrize(
    "name", ["", "/", "cmd_vel", "/a//b", "/a/", "/1a", "/a b", "/a-b", "/ä", "/~", "/a\n", "/a/*"]
)
def test_what_is_no_name_is_refused(name):
    with pytest.raises(ConfigError, match="is not a ROS name"):
        check_name(name, "topic")


@given(st.text(max_size=20))
def test_any_name_is_taken_whole_or_refused(name):
    try:
        namespace, last = node_name(name)
    except ConfigError:
        return
    assert last.isascii()
    assert last.isidentifier()
    assert (namespace.rstrip("/") + "/" + last).endswith("/" + name.lstrip("/"))


PATTERN = bytes((place * 131 + place // 7) % 256 for place in range(1200))


def test_every_length_as_the_reference_has_it():
    digest = hashlib.sha256()
    for length in range(17, 1200):
        low, high = xxh3(PATTERN[:length])
        digest.update(high.to_bytes(8, "big") + low.to_bytes(8, "big"))
    assert digest.hexdigest() == "4e4f1f49f3b19b7cf7b58bf6bf65952a8f9bb20a81d323b791f1517c2ab9c71c"


@pytest.mark.parametrize(
    ("length", "expected"),
    [
        (17, "9fb5d1df5f596243fe29229275898434"),
        (32, "8371440f439c0425c662d67c70c5b7a6"),
        (33, "30faa5eeaf230be598787a2bb7e6bb3c"),
        (64, "11b52e3a3a1ece0bd8045d029ce2e30a"),
        (96, "a1e6f13095f15ca01c22dad05a09df30"),
        (97, "af54c6a3feac4818a20e1a7d4cb2f974"),
        (128, "74c0202f0eccba84f6b9b88d64ef5981"),
        (129, "a002ff0408336266bb0134c2914d613f"),
        (160, "f7d29212cae82de61f914bd766d0926c"),
        (240, "70f8428cd244687592fb8120209f7d7e"),
        (241, "c6eb3a6aa19381d57315654a87656e22"),
        (1024, "ecb1ecee8b05bd5a660f17b831d36059"),
        (1025, "f48fa7f9904e60ba8dc958605ec1686e"),
        (1088, "80458eae30f9764843dc21f77e0a4bb4"),
        (1199, "5193f54e86ab27537bcf13110af7bcf3"),
    ],
)
def test_single_lengths(length, expected):
    low, high = xxh3(PATTERN[:length])
    assert f"{high:016x}{low:016x}" == expected


def test_an_id_is_the_low_half_first_each_little_endian():
    token = "@ros2_lv/0/1/0/0/NN/%/%/node"
    low, high = xxh3(token.encode())
    assert gid(token) == low.to_bytes(8, "little") + high.to_bytes(8, "little")


@given(st.text(min_size=17, max_size=400), st.text(min_size=17, max_size=400))
def test_different_tokens_have_different_ids(one, other):
    assert (gid(one) == gid(other)) == (one == other)


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
