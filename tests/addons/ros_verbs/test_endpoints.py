"""Which endpoints match, by a table of policies; and quality of service as rosbag2 writes and reads it."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.ros_verbs.endpoints import (
    FOREVER_NS,
    GraphEndpoint,
    fitting_qos,
    mismatches,
    open_observer,
    recorded_policies,
    recorded_qos,
    recorded_text,
)
from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import Qos
from edoras_tools.ros import TypeStore

USUAL = {
    "Reliability": "RELIABLE",
    "History (Depth)": "KEEP_LAST (7)",
    "Durability": "VOLATILE",
    "Lifespan": FOREVER_NS,
    "Deadline": FOREVER_NS,
    "Liveliness": "AUTOMATIC",
    "Liveliness lease duration": FOREVER_NS,
}


def endpoint(publishes=True, gid="00", node="/talker", **policies):
    named = {name.replace("_", " "): value for name, value in policies.items()}
    return GraphEndpoint("/a", "std_msgs/msg/String", publishes, gid, node, USUAL | named, "", own=False)


@pytest.mark.parametrize(
    ("offer", "wish", "refused"),
    [
        ({}, {}, []),
        ({"Reliability": "BEST_EFFORT"}, {}, ["reliability"]),
        ({}, {"Reliability": "BEST_EFFORT"}, []),
        ({}, {"Durability": "TRANSIENT_LOCAL"}, ["durability"]),
        ({"Durability": "TRANSIENT_LOCAL"}, {}, []),
        ({"Deadline": 100}, {"Deadline": 100}, []),
        ({"Deadline": 101}, {"Deadline": 100}, ["deadline"]),
        ({}, {"Liveliness": "MANUAL_BY_TOPIC"}, ["liveliness"]),
        ({}, {"Liveliness_lease_duration": 5}, ["liveliness lease duration"]),
        ({"Reliability": "UNKNOWN"}, {}, []),
        ({"Reliability": "BEST_EFFORT"}, {"Durability": "TRANSIENT_LOCAL"}, ["reliability", "durability"]),
    ],
)
def test_a_subscription_may_not_ask_for_more(offer, wish, refused):
    ends = endpoint(**offer), endpoint(publishes=False, gid="01", **wish)
    assert mismatches(ends) == ([(*ends, refused)] if refused else [])


@pytest.mark.parametrize(
    ("offers", "qos"),
    [
        ([{}], Qos(True, False, 1000)),
        ([{"Durability": "TRANSIENT_LOCAL"}], Qos(True, True, 1000)),
        ([{"Durability": "TRANSIENT_LOCAL"}, {}], Qos(True, False, 1000)),
        ([{"Reliability": "BEST_EFFORT"}, {}], Qos(False, False, 1000)),
    ],
)
def test_an_observer_asks_for_what_all_offer(offers, qos):
    assert fitting_qos(endpoint(**item) for item in offers) == qos


@given(
    st.sampled_from(["RELIABLE", "BEST_EFFORT"]),
    st.sampled_from(["VOLATILE", "TRANSIENT_LOCAL"]),
    st.integers(1, 5000),
)
def test_what_is_recorded_is_read_again(reliability, durability, depth):
    changed = {
        "Reliability": reliability,
        "Durability": durability,
        "History (Depth)": f"KEEP_LAST ({depth})",
    }
    text = recorded_text(USUAL | changed)
    assert recorded_policies(text) == [changed]
    assert recorded_qos(text) == Qos(reliability == "RELIABLE", durability == "TRANSIENT_LOCAL", depth)


@pytest.mark.parametrize(
    ("text", "qos"),
    [
        ("", Qos()),
        ("[: nonsense", Qos()),
        ("- history: 1\n  depth: 5\n  reliability: 2\n  durability: 1\n", Qos(False, True, 5)),
        ("- history: 2\n  depth: 0\n  reliability: 1\n  durability: 2\n", Qos(True, False, 0)),
        ("- history: unknown\n  depth: 0\n  reliability: reliable\n  durability: volatile\n", Qos()),
    ],
)
def test_what_rosbag2_writes(text, qos):
    assert recorded_qos(text) == qos


def test_the_text_is_that_of_ros2_topic_info():
    assert endpoint(gid="0a0b", node="/robot/talker").text().splitlines() == [
        "Node name: talker",
        "Node namespace: /robot",
        "Topic type: std_msgs/msg/String",
        "Topic type hash: INVALID",
        "Endpoint type: PUBLISHER",
        "GID: 0a.0b",
        "QoS profile:",
        "  Reliability: RELIABLE",
        "  History (Depth): KEEP_LAST (7)",
        "  Durability: VOLATILE",
        "  Lifespan: Infinite",
        "  Deadline: Infinite",
        "  Liveliness: AUTOMATIC",
        "  Liveliness lease duration: Infinite",
    ]


def test_a_middleware_that_tells_nothing_of_endpoints():
    with pytest.raises(ConfigError, match="--ros zenoh tells nothing of endpoints; there are dds and rclpy"):
        open_observer("zenoh", TypeStore(), "looker", 0, {})
