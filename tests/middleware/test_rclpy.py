"""The node against a stand-in for rclpy that takes and gives what rclpy's documentation says, and no more.

There is no ROS 2 here: that a real one does the same is not shown by these tests.
"""

import itertools
import queue
import sys
import threading
from enum import Enum
from types import ModuleType, SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from waiting import PATIENCE_S

from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.middleware import graph as middleware_graph
from edoras_tools.middleware.rclpy import _Echoes, open_graph
from edoras_tools.ros import TypeStore

TWIST = "geometry_msgs/msg/Twist"


class Ros:
    """A ROS 2 of one process: contexts, nodes, and executors that take messages from queues."""

    def __init__(self):
        self.nodes = []
        self.contexts = []
        self.offers, self.timers, self.events = {}, [], {}
        self.uncounted = False
        self.stamps = itertools.count(1)

    def modules(self):
        ros = self

        class ExternalShutdownException(Exception):  # noqa: N818  rclpy's name
            pass

        class UnsupportedEventTypeError(Exception):
            pass

        class Context:
            def __init__(self):
                self.domain = None
                self.valid = False
                self.on_shutdown = []
                ros.contexts.append(self)

            def ok(self):
                return self.valid

            def try_shutdown(self):
                self.valid = False
                for wake in self.on_shutdown:
                    wake()

        class Policy(Enum):
            RELIABLE, BEST_EFFORT, VOLATILE, TRANSIENT_LOCAL, KEEP_LAST, KEEP_ALL = range(6)

        class QoSProfile:
            def __init__(self, *, history, depth, reliability, durability):
                self.asked = (history.name, depth, reliability.name, durability.name)

        class Publisher:
            def __init__(self, node, kind, topic):
                self.node, self.kind, self.topic = node, kind, topic

            def publish(self, message):
                assert not self.node.destroyed
                if not isinstance(message, bytes | self.kind):
                    raise TypeError(message)
                for node in ros.nodes:
                    for topic, callback in node.subscriptions:
                        if topic == self.topic and node.context.domain == self.node.context.domain:
                            node.executor.work.put((callback, message))

        class Node:
            def __init__(self, name, *, context, namespace, use_global_arguments, start_parameter_services):
                assert context.valid
                if name == "taken":
                    raise RuntimeError("the name is taken")
                assert not use_global_arguments
                assert not start_parameter_services
                self.name, self.namespace, self.context = name, namespace, context
                self.subscriptions, self.profiles = [], {}
                self.destroyed = False
                ros.nodes.append(self)

            def get_name(self):
                return self.name

            def get_namespace(self):
                return self.namespace

            def get_publishers_info_by_topic(self, topic):
                return ros.offers.get(topic, [])

            def create_timer(self, period, follow):
                assert period > 0
                ros.timers.append(follow)

            def destroy_subscription(self, subscription):
                self.subscriptions.remove(subscription)

            def create_subscription(self, kind, topic, callback, qos_profile, *, raw, event_callbacks=None):
                assert raw
                if event_callbacks and ros.uncounted:
                    raise UnsupportedEventTypeError
                ros.events[topic] = event_callbacks
                if topic == "/refused":
                    raise RuntimeError("rcl said no\nat some place")
                self.profiles[topic] = qos_profile.asked
                self.subscriptions.append((topic, callback))
                return self.subscriptions[-1]

            def create_publisher(self, kind, topic, qos_profile):
                if topic == "/refused":
                    raise RuntimeError("rcl said no\nat some place")
                self.profiles[topic] = qos_profile.asked
                return Publisher(self, kind, topic)

            def destroy_node(self):
                self.destroyed = True
                ros.nodes.remove(self)

        class SingleThreadedExecutor:
            def __init__(self, *, context):
                self.context, self.work = context, queue.SimpleQueue()
                context.on_shutdown.append(lambda: self.work.put(None))

            def add_node(self, node):
                node.executor = self

            def spin(self):
                while self.context.ok():
                    if (item := self.work.get()) is not None:
                        callback, message = item
                        callback(message, {"source_timestamp": next(ros.stamps)})
                raise ExternalShutdownException

            def shutdown(self):
                assert not self.context.ok()

        def init(*, args, context, domain_id):
            assert args == []
            if domain_id == 99:
                raise RuntimeError("failed to create domain")
            context.domain, context.valid = domain_id, True

        contents = {
            "rclpy": {"init": init, "create_node": Node},
            "rclpy.context": {"Context": Context},
            "rclpy.executors": {
                "SingleThreadedExecutor": SingleThreadedExecutor,
                "ExternalShutdownException": ExternalShutdownException,
            },
            "rclpy.event_handler": {
                "SubscriptionEventCallbacks": SimpleNamespace,
                "UnsupportedEventTypeError": UnsupportedEventTypeError,
            },
            "rclpy.qos": {
                "QoSProfile": QoSProfile,
                "ReliabilityPolicy": Policy,
                "DurabilityPolicy": Policy,
                "HistoryPolicy": Policy,
            },
            "geometry_msgs": {},
            "geometry_msgs.msg": {"Twist": type("Twist", (), {})},
        }
        for name, items in contents.items():
            module = ModuleType(name)
            module.__dict__.update(items)
            yield name, module


@pytest.fixture
def ros(monkeypatch):
    ros = Ros()
    for name, module in ros.modules():
        monkeypatch.setitem(sys.modules, name, module)
    return ros


@pytest.fixture(scope="module")
def store():
    return TypeStore()


@pytest.fixture
def graph(ros, store):
    graph = open_graph(store, "/robot/bridge", domain=7)
    yield graph
    graph.close()


@pytest.fixture
def other(ros, store):
    graph = open_graph(store, "other", domain=7)
    yield graph
    graph.close()


def test_a_node_of_its_own_context_and_domain(ros, graph):
    node = ros.nodes[0]
    assert (node.namespace, node.name, node.context.domain) == ("/robot", "bridge", 7)
    assert "bridge" in {thread.name for thread in threading.enumerate()}


def test_bytes_go_out_and_come_in_as_they_are(graph, other, until):
    heard = []
    other.subscribe("/pose", TWIST, Qos(), heard.append)
    publish = graph.advertise("/pose", TWIST, Qos())
    sent = [b"\x00\x01\x00\x00" + bytes([number]) * 48 for number in range(100)]
    for cdr in sent:
        publish(cdr)
    until(lambda: len(heard) == 100)
    assert heard == sent


def test_a_node_never_hears_itself_and_hears_others_who_say_the_same(graph, other, until):
    early, late = [], []
    graph.subscribe("/both", TWIST, Qos(), early.append)
    mine = graph.advertise("/both", TWIST, Qos())
    graph.subscribe("/both", TWIST, Qos(), late.append)
    theirs = other.advertise("/both", TWIST, Qos())
    for publish, cdr in [(mine, b"a"), (theirs, b"a"), (mine, b"b"), (theirs, b"c"), (mine, b"a")]:
        publish(cdr)
    theirs(b"end")
    until(lambda: b"end" in early and b"end" in late)
    assert sorted(early) == sorted(late) == [b"a", b"c", b"end"]


@pytest.mark.parametrize(
    ("qos", "asked"),
    [
        (Qos(), ("KEEP_LAST", 10, "RELIABLE", "VOLATILE")),
        (Qos(reliable=False, depth=1), ("KEEP_LAST", 1, "BEST_EFFORT", "VOLATILE")),
        (Qos(transient_local=True, depth=0), ("KEEP_ALL", 0, "RELIABLE", "TRANSIENT_LOCAL")),
    ],
)
def test_quality_of_service_by_rclpys_names(ros, graph, qos, asked):
    graph.subscribe("/in", TWIST, qos, print)
    graph.advertise("/out", TWIST, qos)
    deep = (asked[0], max(asked[1], 1000), *asked[2:]) if asked[3] == "VOLATILE" else asked
    assert ros.nodes[0].profiles == {"/in": deep, "/out": asked}


@pytest.mark.parametrize(
    ("qos", "offers", "asked"),
    [
        (Qos(None, None), [], "RELIABLE VOLATILE"),
        (Qos(None, None), ["RELIABLE TRANSIENT_LOCAL"] * 2, "RELIABLE TRANSIENT_LOCAL"),
        (Qos(None, None), ["RELIABLE TRANSIENT_LOCAL", "RELIABLE VOLATILE"], "RELIABLE VOLATILE"),
        (Qos(None, None), ["BEST_EFFORT VOLATILE", "RELIABLE VOLATILE"], "BEST_EFFORT VOLATILE"),
        (Qos(True, None), ["BEST_EFFORT TRANSIENT_LOCAL"], "RELIABLE TRANSIENT_LOCAL"),
        (Qos(None, False), ["BEST_EFFORT TRANSIENT_LOCAL"], "BEST_EFFORT VOLATILE"),
    ],
)  # fmt: skip
def test_what_all_publishers_offer_is_followed(ros, graph, other, until, qos, offers, asked):
    """The subscription is made anew; what the old one and the new one hear both is heard once."""
    heard, policies = [], sys.modules["rclpy.qos"].ReliabilityPolicy
    graph.subscribe("/in", TWIST, qos, heard.append)
    ros.offers["/in"] = [
        SimpleNamespace(
            node_name="talker",
            node_namespace="/",
            qos_profile=SimpleNamespace(
                **{
                    name: policies[word]
                    for name, word in zip(("reliability", "durability"), text.split(), strict=False)
                }
            ),
        )
        for text in offers
    ]
    (follow,) = ros.timers
    follow()
    assert " ".join(ros.nodes[0].profiles["/in"][2:]) == asked
    (state,) = graph.states().values()
    assert " ".join(map(str, state.qos[0].words().values())) == f"{asked.lower()} 10"
    publish = other.advertise("/in", TWIST, Qos())
    ros.stamps = iter([1, 1, 2, 2] if len(ros.nodes[0].subscriptions) == 2 else [1, 2])
    publish(b"a")
    until(lambda: len(heard) == 1)
    ros.events["/in"].message_lost(SimpleNamespace(total_count=3))
    assert graph.states()["/in"].missed == 3
    follow()
    assert len(ros.nodes[0].subscriptions) == 1


def test_a_middleware_that_does_not_count_is_heard_all_the_same(ros, graph):
    ros.uncounted = True
    graph.subscribe("/in", TWIST, Qos(), print)
    assert graph.states()["/in"].missed == 0


def test_nothing_is_heard_once_closed(ros, graph, other):
    heard, going, release = [], threading.Event(), threading.Event()

    def slow(cdr):
        going.set()
        assert release.wait(PATIENCE_S)
        heard.append(cdr)

    graph.subscribe("/pose", TWIST, Qos(), slow)
    publish = other.advertise("/pose", TWIST, Qos())
    own = graph.advertise("/pose", TWIST, Qos())
    for _ in range(5):
        publish(b"x")
    assert going.wait(PATIENCE_S)
    closing = threading.Thread(target=graph.close)
    closing.start()
    release.set()
    closing.join(PATIENCE_S)
    assert not closing.is_alive()
    count = len(heard)
    graph.close()
    publish(b"late")
    own(b"ignored")
    assert 1 <= len(heard) == count <= 5
    assert [node.name for node in ros.nodes] == ["other"]


def test_what_rclpy_refuses_is_one_line(graph):
    for join in (graph.advertise, lambda *rest: graph.subscribe(*rest, print)):
        with pytest.raises(ConfigError, match=r"^/refused: refused by rclpy: rcl said no$"):
            join("/refused", TWIST, Qos())
        with pytest.raises(ConfigError, match="this ROS 2 has no std_msgs/msg/String: No module named"):
            join("/text", "std_msgs/msg/String", Qos())
        with pytest.raises(ConfigError, match="/text: type 'no_msgs/msg/No' is not known"):
            join("/text", "no_msgs/msg/No", Qos())
        with pytest.raises(ConfigError, match="topic 'text' is not a ROS name"):
            join("text", TWIST, Qos())


def test_what_cannot_be_opened_is_one_line(ros, store):
    with pytest.raises(ConfigError, match="no node 'bridge' in domain 99: failed to create domain"):
        open_graph(store, "bridge", domain=99)
    with pytest.raises(ConfigError, match="no node 'taken' in domain 0: the name is taken"):
        open_graph(store, "taken")
    assert not any(context.ok() for context in ros.contexts)
    with pytest.raises(ConfigError, match="node '/1' is not a ROS name"):
        open_graph(store, "1")
    with pytest.raises(ConfigError, match="--ros rclpy has no option 'router'"):
        open_graph(store, "bridge", options={"router": "x"})
    assert not ros.nodes


def test_without_a_ros_one_line_says_so(store, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ConfigError) as caught:
        middleware_graph.open_graph("rclpy", store, "bridge")
    assert str(caught.value).startswith("--ros rclpy needs a ROS 2 of Python 3.")
    assert "\n" not in str(caught.value)


@given(st.lists(st.tuples(st.booleans(), st.sampled_from([b"a", b"b", b"c"])), max_size=40))
def test_of_equal_messages_as_many_are_left_out_as_were_sent(happened):
    """Echoes and the others' messages come in any order; what stays is as much as the others sent."""
    echoes = _Echoes()
    heard = SimpleNamespace(mine=[], others=[])
    for own, cdr in happened:
        if own:
            echoes.expect(cdr)
        (heard.mine if own else heard.others).append(cdr)
    taken = [cdr for cdr in heard.others + heard.mine if not echoes.take(cdr)]
    assert sorted(taken) == sorted(heard.others)
