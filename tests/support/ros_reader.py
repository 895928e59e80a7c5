"""A node of a real ROS 2, run by the Python that has its wheels: it prints what it hears, as it came.

    python ros_reader.py TYPE TOPIC reliable|best_effort ...

A line of JSON for each message: its topic, and its CDR in hex. It ends when its standard input does.
"""

import contextlib
import importlib
import json
import sys
import threading

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, QoSReliabilityPolicy


def main():
    words = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node("reader")
    for type_name, topic, reliability in zip(words[::3], words[1::3], words[2::3], strict=True):
        package, kind, last = type_name.split("/")
        message = getattr(importlib.import_module(f"{package}.{kind}"), last)
        quality = QoSProfile(depth=1000, reliability=QoSReliabilityPolicy[reliability.upper()])

        def hear(data, topic=topic):
            print(json.dumps({"heard": topic, "cdr": bytes(data).hex()}), flush=True)

        node.create_subscription(message, topic, hear, quality, raw=True)

    def end():
        sys.stdin.read()
        rclpy.try_shutdown()

    print(json.dumps({}), flush=True)
    threading.Thread(target=end, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


if __name__ == "__main__":
    main()
