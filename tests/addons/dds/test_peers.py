"""What is told of the endpoints of others: who has another type, another definition, a hash that is none."""

from types import SimpleNamespace
from uuid import uuid4

import pytest

from edoras_tools.addons.dds.graph import (
    PRESENCE_TOPIC,
    PRESENCE_TYPE,
    Discovered,
    OwnEndpoint,
    PeerEndpoint,
    presence_types,
)
from edoras_tools.ros.type_hash import type_hash

TWIST, HASH, OTHER = "geometry_msgs/msg/Twist", "RIHS01_" + 64 * "a", "RIHS01_" + 64 * "b"
OURS = OwnEndpoint("/cmd_vel", TWIST, writes=False, type_hash=HASH, matched=False)


def peers(*found):
    """Return the peers of a participant that has found some endpoints."""
    made = Discovered.__new__(Discovered)
    made.found = {uuid4(): item for item in found}
    return made


def writer(topic="rt/cmd_vel", type_name="geometry_msgs::msg::dds_::Twist_", type_hash=HASH, writes=True):
    return PeerEndpoint(topic, type_name, writes, type_hash)


CASES = [
    (writer(), ""),
    (writer(type_hash=""), ""),
    (
        writer(type_name="geometry_msgs::msg::dds_::Pose_", type_hash=OTHER),
        "/cmd_vel: a publisher has type geometry_msgs/msg/Pose, not geometry_msgs/msg/Twist; write type: ",
    ),
    (
        writer(type_name="Odd::Type"),
        "/cmd_vel: a publisher has type Odd::Type, not geometry_msgs/msg/Twist; ",
    ),
    (
        writer(type_hash=OTHER),
        "/cmd_vel: a publisher has another definition of geometry_msgs/msg/Twist (RIHS01_bbbbbbbbbbbb...",
    ),
    (
        writer(type_hash="RIHS01_12"),
        "/cmd_vel: a publisher has an invalid type hash, 'RIHS01_12'; continuing",
    ),
    (
        writer(type_hash="x" * 9999),
        "/cmd_vel: a publisher has an invalid type hash, '" + 71 * "x" + "'; continuing",
    ),
    (
        writer("rt/robot/cmd_vel"),
        "/cmd_vel: nobody publishes it, but /robot/cmd_vel; if it is that, write topic: /robot/cmd_vel",
    ),
    (writer("rt/something_else"), ""),
    (writer("rq/cmd_vel"), ""),
    (writer(type_name="Odd::Type", writes=False), ""),
]


@pytest.mark.parametrize(("item", "said"), CASES)
def test_what_is_told(item, said):
    told = list(peers(item).notes([OURS], late=True))
    assert [line[: len(said)] for line in told] == ([said] if said else [])


def test_a_topic_of_another_name_is_told_late_and_never_one_of_ours():
    other = OwnEndpoint("/robot/cmd_vel", TWIST, writes=False, type_hash=HASH, matched=True)
    found = peers(writer("rt/robot/cmd_vel"))
    assert list(found.notes([OURS], late=False)) == []
    assert list(found.notes([OURS, other], late=True)) == []


def test_the_size_of_identifiers_is_that_of_the_others():
    older = type_hash(presence_types(24), PRESENCE_TYPE)
    newer = type_hash(presence_types(16), PRESENCE_TYPE)
    of = {told: writer(PRESENCE_TOPIC, type_hash=told) for told in ("", older, newer)}
    assert peers().gid_bytes is None
    assert peers(writer()).gid_bytes is None
    assert [peers(of[""]).gid_bytes, peers(of[older]).gid_bytes, peers(of[newer]).gid_bytes] == [24, 24, 16]
    assert peers(of[""], of[newer]).gid_bytes == 16


def test_user_data_of_any_form_is_read(monkeypatch):
    from edoras_tools.addons.dds import graph as module

    monkeypatch.setattr(module, "Policy", SimpleNamespace(Userdata=SimpleNamespace))
    for data, told in [
        (b"typehash=RIHS01_1;", "RIHS01_1"),
        (b"a=b;typehash=x\0", "x"),
        (b"typehash=\xff", "\ufffd"),
        (b"", ""),
        (b"enclave=/;", ""),
    ]:
        assert module.hash_of([SimpleNamespace(data=data)]) == told
