"""Names as a real ROS 2 resolves them, by the Python that has its wheels.

It reads cases as JSON, ``[NAMESPACE, WORDS, TOPICS]`` each: a node ``bridge`` of that namespace is started
with those words after ``--ros-args``. Of each it prints the node's full name, that of every topic, null where
it is refused, and its parameters; null alone where the node is not even started.
"""

import json
import sys

import rclpy
from rclpy.context import Context


def resolved(namespace, words, topics):
    """Return the names of one case."""
    context = Context()
    try:
        rclpy.init(args=["program", "--ros-args", *words], context=context)
        options = {"start_parameter_services": False, "automatically_declare_parameters_from_overrides": True}
        node = rclpy.create_node("bridge", context=context, namespace=namespace, **options)
    except Exception:  # noqa: BLE001  rclpy raises classes of its own
        return None
    names = [node.get_fully_qualified_name()]
    for topic in topics:
        try:
            names.append(node.resolve_topic_name(topic))
        except Exception:  # noqa: BLE001  as above
            names.append(None)
    values = {name[3:]: item.value for name, item in node._parameters.items() if name.startswith("of.")}
    node.destroy_node()
    context.try_shutdown()
    return names, values


if __name__ == "__main__":
    print(json.dumps([resolved(*case) for case in json.load(sys.stdin)]))
