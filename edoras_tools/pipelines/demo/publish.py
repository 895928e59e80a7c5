"""Publishes what Foxglove sends in the ROS 2 graph of a demo, so that robots can be driven from there."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.io.foxglove.publishing import Publisher
from edoras_tools.middleware import Qos

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.middleware import Graph
    from edoras_tools.pipelines.demo.scene import Lane
    from edoras_tools.ros import TypeStore


def commands(lanes: Sequence[Lane], types: TypeStore, graph: Graph) -> Publisher:
    """Return a publisher that accepts the robots' commands and publishes them in the graph."""
    topics = ", ".join(lane.command.topic for lane in lanes)
    publisher = Publisher(types, lambda topic: f"{topic} is not a command topic; there are {topics}")
    for lane in lanes:
        topic, type_name = lane.command.topic, lane.command.type
        publisher.accept(topic, type_name, graph.advertise(topic, type_name, Qos()))
    return publisher
