"""Quality of service and histories against a real node, its publishers and subscriptions of all kinds."""

import os
import signal
from contextlib import ExitStack, contextmanager
from functools import partial

import pytest
from effort import LONG
from ros_wheels import APART, Talk

from edoras_tools.addons.dds.endpoints import room_of
from edoras_tools.addons.dds.graph import open_graph
from edoras_tools.middleware import Qos
from edoras_tools.ros import TypeStore

STRING = "std_msgs/msg/String"
TYPES = TypeStore()
KINDS = [(reliable, lasting) for reliable in (True, False) for lasting in (True, False)]
NAMES = [APART[-1]] if not LONG else APART


@contextmanager
def both(name, monkeypatch, **variables):
    """Open a real node and a graph of ours in a domain of their own."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with Talk(name, **variables) as talk, ExitStack() as stack:
        graph = open_graph(TypeStore(name), "bridge", domain=14)
        stack.callback(graph.close)
        yield talk, graph


def take(numbers, cdr):
    """Add the number in a message."""
    numbers.append(int(TYPES.decode(STRING, cdr)["data"]))


def message(number):
    return TYPES.encode(STRING, {"data": str(number)})


def word(kind):
    return "".join(
        "no"[: 2 * (not item)] + part for item, part in zip(kind, ("reliable", "lasting"), strict=True)
    )


@pytest.mark.parametrize("name", NAMES)
def test_of_each_kind_of_publisher_what_may_be_heard_is(name, monkeypatch, until):
    """Each of four publishers beside each of four subscriptions, and one that follows; and the other way."""
    asked = {**{word(kind): kind for kind in KINDS}, "automatic": (None, None)}
    with both(name, monkeypatch) as (talk, graph):
        heard, publish = {}, {}
        for offer in KINDS:
            for label, kind in asked.items():
                topic = f"/in/{word(offer)}/{label}"
                talk.tell(speak=topic, reliable=offer[0], transient_local=offer[1], depth=3)
                talk.tell(say=[topic], **{"from": 0, "to": 5})
                heard[topic] = []
                graph.subscribe(topic, STRING, Qos(*kind), partial(take, heard[topic]))
            for kind in KINDS:
                topic = f"/out/{word(offer)}/{word(kind)}"
                publish[topic] = graph.advertise(topic, STRING, Qos(*offer, depth=3))
                publish[topic](message(0))
                talk.tell(hear=topic, reliable=kind[0], transient_local=kind[1], depth=3)
        fits = {
            f"{way}/{word(offer)}/{label}": all(
                one or not other for one, other in zip(offer, kind, strict=True)
            )
            for way in ("/in", "/out")
            for offer in KINDS
            for label, kind in asked.items()
        }

        def complete():
            told = talk.tell(ask=True)
            matched = {
                **{topic: bool(count) for topic, count in told["subscriptions"].items()},
                **{topic: graph.subscribers(topic) > 0 for topic in publish},
            }
            return matched == {topic: fits[topic] for topic in matched} or None

        until(complete)
        # What is kept for late subscriptions goes to those that want it, and only reliably.
        kept = {f"/in/{word((True, True))}/{label}": [2, 3, 4] for label in (word((True, True)), "automatic")}
        until(lambda: {topic: numbers for topic, numbers in heard.items() if numbers} == kept)
        number = 5

        def all_heard():
            nonlocal number
            talk.tell(say=[*heard], **{"from": number, "to": number + 1})
            for say in publish.values():
                say(message(number))
            number += 1
            back = talk.tell(ask=True)["heard"]
            return all(
                bool(heard[topic][-1:] if topic in heard else back.get(topic)) == fits[topic]
                for topic in (*heard, *publish)
            )

        until(all_heard)
        for topic, numbers in heard.items():
            assert numbers == sorted({*numbers}), topic
        notes = "\n".join(graph.notes())
        for topic in (*heard, *publish):
            assert (f"{topic}: " in notes) is not fits[topic], (topic, notes)
        followed = {topic: graph.states()[topic].qos for topic in heard if topic.endswith("automatic")}
        assert followed == {f"/in/{word(kind)}/automatic": (Qos(*kind),) for kind in KINDS}


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_what_publishes_changes_and_is_followed(name, monkeypatch, until):
    with both(name, monkeypatch) as (talk, graph):
        heard, topic = [], "/in"
        graph.subscribe(topic, STRING, Qos(None, None), partial(take, heard))
        number = 0

        def speaks(expected):
            first = number

            def say():
                nonlocal number
                talk.tell(say=[topic], **{"from": number, "to": number + 1})
                number += 1
                kinds = {Qos(*kind) for kind in expected}
                told = talk.tell(ask=True)["infos"][topic]
                return (
                    {*graph.states()[topic].qos} == kinds
                    and len(told) == len(kinds)
                    and heard
                    and heard[-1] >= first
                )

            until(say, lambda: f"{expected} {graph.states()} {talk.tell(ask=True)['infos']}")

        for kind in KINDS:
            talk.tell(speak=topic, reliable=kind[0], transient_local=kind[1])
            speaks([kind])
            talk.tell(hush=topic)
        with Talk(name) as other:
            talk.tell(speak=topic)
            other.tell(speak=topic, reliable=False)
            speaks([(True, False), (False, False)])
            other.tell(say=[topic], **{"from": 10_000, "to": 10_001})
            until(lambda: 10_000 in heard)
        assert [item for item in heard if item != 10_000] == sorted({*heard} - {10_000})


@pytest.mark.long
@pytest.mark.parametrize("name", APART)
def test_what_a_history_of_ours_overwrites_is_counted(name, monkeypatch, until):
    """A subscriber stands still while more is published than is kept for it."""
    with both(name, monkeypatch) as (talk, graph):
        publish = graph.advertise("/out", STRING, Qos(transient_local=True))
        talk.tell(hear="/out", depth=2000)
        until(lambda: graph.subscribers("/out") and talk.tell(ask=True)["publishers"]["/out"])
        count, room = 500, room_of(Qos(), None)
        publish(message(0))
        until(graph.acknowledged)
        os.kill(talk.process.pid, signal.SIGSTOP)
        try:
            for number in range(1, count):
                publish(message(number))
        finally:
            os.kill(talk.process.pid, signal.SIGCONT)

        def last():
            told = talk.tell(ask=True)
            return str(count - 1) in told["heard"].get("/out", []) and told

        told = until(last)
        missing = count - len(told["heard"]["/out"])
        assert missing == told["lost"].get("/out", missing)
        assert count - room > missing > 0
        assert missing <= graph.states()["/out"].overwritten <= count - room
