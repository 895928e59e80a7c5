"""A node of a real ROS 2, run by the Python that has its wheels: what it hears it says again.

    python ros_peer.py NODE ROUTE...

A route is ``TYPE TOPIC ANSWERS``: what comes on ``TOPIC`` is deserialised, and published on ``ANSWERS``. When
its subscriptions stand, ``ready`` is printed. For each line on its standard input, the name of a node, it
prints as JSON on which of the topics that node publishes now, and the hash that each publisher gives of its
type; it ends when there are no more. It needs no library but those wheels.
"""

import contextlib
import importlib
import json
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile


def main():
    name, *words = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node(name)
    for type_name, topic, answers in zip(words[::3], words[1::3], words[2::3], strict=True):
        package, kind, last = type_name.split("/")
        message = getattr(importlib.import_module(f"{package}.{kind}"), last)
        publisher = node.create_publisher(message, answers, QoSProfile(depth=100))
        node.create_subscription(message, topic, publisher.publish, QoSProfile(depth=100))

    def answer():
        for line in sys.stdin:
            other = line.strip()
            named = other in node.get_node_names()
            theirs = dict(node.get_publisher_names_and_types_by_node(other, "/")) if named else {}
            found = {topic: node.get_publishers_info_by_topic(topic) for topic in words[1::3]}
            seen = {
                topic: str(ends[0].topic_type_hash)
                for topic, ends in found.items()
                if ends and topic in theirs
            }
            print(json.dumps(seen), flush=True)
        rclpy.try_shutdown()

    print("ready", flush=True)
    threading.Thread(target=answer, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
