from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.foxglove.server.protocol import Publisher
from edoras_tools.ros import TypeStore

TWIST = "geometry_msgs/msg/Twist"
STORE = TypeStore()
CDR = STORE.encode(TWIST, {"linear": {"x": 0.5}})


def publisher():
    """A publisher of one topic, and what it took."""
    taken = []
    made = Publisher(STORE, "{} is not here".format)
    made.accept("/cmd_vel", TWIST, lambda cdr: taken.append(cdr) or "")
    return made, taken


@pytest.mark.parametrize(
    ("type_name", "encoding", "data"),
    [
        (TWIST, "cdr", CDR),
        ("geometry_msgs/Twist", "cdr", CDR),
        (TWIST, "json", json.dumps({"linear": {"x": 0.5}}).encode()),
    ],
)
def test_a_message_of_the_topics_type_is_handed_on_as_cdr(type_name, encoding, data):
    made, taken = publisher()
    assert made.topics == ["/cmd_vel"]
    assert made.publish("/cmd_vel", type_name, encoding, data) == ""
    assert taken == [CDR]


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (("/other", TWIST, "cdr", CDR), "/other is not here"),
        (("/cmd_vel", "std_msgs/String", "cdr", CDR), f"/cmd_vel has type {TWIST}, not std_msgs/String"),
        (("/cmd_vel", "", "cdr", CDR), f"/cmd_vel has type {TWIST}, not a type without name"),
        (("/cmd_vel", TWIST, "ros1", CDR), "/cmd_vel: ros1 is not understood; publish cdr or json"),
        (("/cmd_vel", TWIST, "cdr", CDR[:20]), "/cmd_vel: "),
        (("/cmd_vel", TWIST, "json", b"{"), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"\xff"), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"[" * 100_000), "/cmd_vel: is not JSON"),
        (("/cmd_vel", TWIST, "json", b"[]"), "/cmd_vel: a message must be a JSON object"),
        (("/cmd_vel", TWIST, "json", b'{"speed": 1}'), "speed"),
    ],
)
def test_what_does_not_fit_is_refused_in_a_line(message, why):
    made, taken = publisher()
    told = made.publish(*message)
    assert why in told
    assert "\n" not in told
    assert not taken


def test_who_takes_messages_may_refuse_one():
    made, _ = publisher()
    made.accept("/full", TWIST, lambda _: "no room")
    assert made.publish("/full", TWIST, "cdr", CDR) == "no room"


@given(st.text(max_size=20), st.sampled_from(["cdr", "json", "x"]), st.binary(max_size=100))
def test_anything_may_be_published_and_only_messages_are_taken(type_name, encoding, data):
    for name in (type_name, TWIST):
        made, taken = publisher()
        assert bool(made.publish("/cmd_vel", name, encoding, data)) != bool(taken)
