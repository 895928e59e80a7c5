"""Keys, tokens and ids as the design has them, attachments as Zenoh's own."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh import ZBytes
from zenoh.ext import Int64, z_deserialize, z_serialize

from edoras_tools.addons.zenoh.identity import (
    ATTACHMENT,
    GID,
    KeyedTopic,
    NodeTokens,
    TokenKind,
    depth,
    gid,
    qos_text,
)
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.middleware.graph import check_name, node_name

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


@pytest.mark.parametrize(
    ("token", "expected"),
    [
        (
            NodeTokens.of_node("listener", 2, "aac3178e146ba6f1fc6e6a4085e77f21").token,
            "49877999dacb858702d11ac823785912",
        ),
        (
            NodeTokens.of_node("talker", 2, "8b20917502ee955ac4476e0266340d5c").entity_token(
                TokenKind.PUBLISHER, 10, CHATTER, Qos(depth=7)
            ),
            "ac170f31eadcd9ff0cd86d7a17907d1c",
        ),
    ],
)
def test_an_id_is_the_xxh3_hash_the_least_significant_byte_first(token, expected):
    assert gid(token).hex() == expected


@given(st.text(min_size=17, max_size=400), st.text(min_size=17, max_size=400))
def test_different_tokens_have_different_ids(one, other):
    assert (gid(one) == gid(other)) == (one == other)


NUMBERS = st.integers(-(2**63), 2**63 - 1)


@given(NUMBERS, NUMBERS, st.binary(min_size=16, max_size=16))
def test_zenohs_own_serializer_writes_and_reads_the_same(number, time, source):
    raw = ATTACHMENT.pack(number, time, GID, source)
    assert z_serialize((Int64(number), Int64(time), source)).to_bytes() == raw
    assert z_deserialize(tuple[Int64, Int64, bytes], ZBytes(raw)) == (number, time, source)
    assert ATTACHMENT.unpack(raw) == (number, time, GID, source)
