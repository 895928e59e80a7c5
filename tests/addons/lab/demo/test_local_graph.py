"""The graph inside the process: who hears whom."""

from __future__ import annotations

from contextlib import closing

import pytest

from edoras_tools.addons.lab.demo.local_graph import open_graph
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.ros import TypeStore

TWIST, POSE = "geometry_msgs/msg/Twist", "geometry_msgs/msg/Pose"
STORE = TypeStore()
CDR = b"\0\1\0\0data"


@pytest.fixture
def node():
    opened = []

    def join(name="node", domain=7):
        graph = open_graph(STORE, name, domain=domain)
        opened.append(graph)
        return graph

    yield join
    for graph in opened:
        graph.close()
        graph.close()


def test_others_hear_and_a_node_never_hears_itself(node):
    first, second, elsewhere = node(), node(), node(domain=8)
    heard = []
    for name, graph in {"first": first, "second": second, "elsewhere": elsewhere}.items():
        graph.subscribe("/a", TWIST, Qos(), lambda cdr, name=name: heard.append((name, cdr)))
    second.subscribe("/b", TWIST, Qos(), heard.append)
    first.advertise("/a", TWIST, Qos())(CDR)
    assert heard == [("second", CDR)]


def test_late_subscribers_get_the_last_samples_where_both_want_it(node):
    publish = node().advertise("/a", TWIST, Qos(transient_local=True, depth=2))
    for item in (b"1", b"2", b"3"):
        publish(item)
    late, volatile = [], []
    node().subscribe("/a", TWIST, Qos(transient_local=True), late.append)
    node().subscribe("/a", TWIST, Qos(), volatile.append)
    publish(b"4")
    assert (late, volatile) == ([b"2", b"3", b"4"], [b"4"])


@pytest.mark.parametrize(
    ("offered", "asked", "match"),
    [
        (Qos(), Qos(), True),
        (Qos(), Qos(reliable=False), True),
        (Qos(reliable=False), Qos(), False),
        (Qos(transient_local=True), Qos(), True),
        (Qos(), Qos(transient_local=True), False),
    ],
)
def test_who_asks_for_more_than_is_offered_hears_nothing(node, offered, asked, match):
    heard = []
    node().subscribe("/a", TWIST, asked, heard.append)
    node().advertise("/a", TWIST, offered)(CDR)
    assert heard == [CDR] * match


def test_after_closing_nothing_is_heard_or_said(node):
    heard = []
    first, second = node(), node()
    first.subscribe("/a", TWIST, Qos(), heard.append)
    publish = second.advertise("/a", TWIST, Qos(transient_local=True))
    second.close()
    publish(CDR)
    third = node()
    third.subscribe("/a", TWIST, Qos(transient_local=True), heard.append)
    third.close()
    with closing(node()) as fourth:
        fourth.advertise("/a", TWIST, Qos())(CDR)
    assert heard == [CDR]


def test_a_topic_has_one_type_and_it_is_known(node):
    graph = node()
    graph.advertise("/a", TWIST, Qos())
    with pytest.raises(ConfigError, match=r"^/a is geometry_msgs/msg/Twist in this graph, not .*/Pose"):
        graph.subscribe("/a", POSE, Qos(), print)
    with pytest.raises(ConfigError, match=r"Twister.* is not known"):
        graph.subscribe("/b", "geometry_msgs/msg/Twister", Qos(), print)
    graph.close()
    node().advertise("/a", POSE, Qos())  # the last one to leave takes the type along


def test_it_has_no_options():
    with pytest.raises(ConfigError, match=r"no option 'mode'"):
        open_graph(STORE, "node", options={"mode": "x"})
