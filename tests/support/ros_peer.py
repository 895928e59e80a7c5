"""A node of a real ROS 2, run by the Python that has its wheels: what it hears it says again.

    python ros_peer.py NODE ROUTE...

A route is ``TYPE TOPIC ANSWERS``: what comes on ``TOPIC`` is deserialised, and published on ``ANSWERS``. When
its subscriptions stand, ``ready`` is printed. It ends when its standard input does, and prints as JSON who
published on each topic, and the hash of its type. It needs no library but those wheels.
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

    seen = {}

    def look():
        for topic in words[1::3]:
            for found in node.get_publishers_info_by_topic(topic):
                # A node that comes or goes is not known by its name.
                if not any(word in found.node_name for word in ("_BARE_DDS_APP_", "_NAME_UNKNOWN_")):
                    seen[topic] = [found.node_namespace + found.node_name, str(found.topic_type_hash)]

    node.create_timer(0.1, look)

    def until_the_end():
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=until_the_end, daemon=True).start()
    print("ready", flush=True)
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
    print(json.dumps(seen))


if __name__ == "__main__":
    main()
