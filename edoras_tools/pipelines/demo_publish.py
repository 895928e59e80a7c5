"""What Foxglove publishes, into the ROS 2 graph of a demo: its robots may be driven from there."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from edoras_tools.errors import EdorasError
from edoras_tools.middleware import Qos

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.middleware import Graph
    from edoras_tools.pipelines.demo_scene import Lane
    from edoras_tools.ros import TypeStore


class Commander:
    """A ``Publisher`` that is a node of the graph.

    Args:
        lanes: the robots; their commands on the ground may be published.
        types: the ROS types.
        graph: the node.
    """

    def __init__(self, lanes: Sequence[Lane], types: TypeStore, graph: Graph) -> None:
        self._types = types
        self._topics = {
            lane.command.topic: (
                lane.command.type,
                graph.advertise(lane.command.topic, lane.command.type, Qos()),
            )
            for lane in lanes
        }

    def refusal(self, topic: str, type_name: str, encoding: str) -> str:
        """Return why a client may not publish there; empty where it may."""
        if topic not in self._topics:
            return f"{topic} commands no robot; there are {', '.join(self._topics)}"
        wanted = self._topics[topic][0]
        if type_name.replace("/msg/", "/") != wanted.replace("/msg/", "/"):
            return f"{topic} takes {wanted}, not {type_name or 'a type without name'}"
        if encoding not in {"cdr", "json"}:
            return f"{topic}: {encoding} is not understood; publish json or cdr"
        return ""

    def publish(self, topic: str, type_name: str, encoding: str, data: bytes) -> str:
        """Take a message; return why not, empty where it was taken."""
        why = self.refusal(topic, type_name, encoding)
        if why:
            return why
        wanted, publish = self._topics[topic]
        try:
            if encoding == "json":
                values: Any = json.loads(data)
                if not isinstance(values, dict):
                    return f"{topic}: a message is a JSON object"
                data = self._types.encode(wanted, values)
            else:
                self._types.decode(wanted, data)
            publish(data)
        except (EdorasError, ValueError, RecursionError) as error:
            return f"{topic}: {error}"
        return ""
