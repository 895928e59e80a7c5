"""Nodes of a real ROS 2, run by the Python that has its wheels: a plain clock, and one that hears two.

    python ros_clock.py tick TOPIC HZ
    python ros_clock.py hear TOPIC CLOCK...

``tick`` publishes the time with a timer until its standard input ends. ``hear`` then prints as JSON what came
on TOPIC, TwistStamped, and for each message on a CLOCK when it came and what it says.
"""

import contextlib
import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock


def tick(topic, hertz):
    node = rclpy.create_node("plain_clock")
    publisher = node.create_publisher(Clock, topic, QoSProfile(depth=10))
    node.create_timer(
        1 / float(hertz), lambda: publisher.publish(Clock(clock=node.get_clock().now().to_msg()))
    )
    return node, {}


def hear(topic, *names):
    node = rclpy.create_node("clock_listener")
    heard, clocks = [], {name: [] for name in names}
    node.create_subscription(
        TwistStamped, topic, lambda message: heard.append(message.twist.linear.x), QoSProfile(depth=1000)
    )
    for name, rows in clocks.items():

        def note(message, rows=rows):
            rows.append((time.time_ns(), message.clock.sec * 10**9 + message.clock.nanosec))

        node.create_subscription(Clock, name, note, QoSProfile(depth=100))
    return node, {"heard": heard, "clocks": clocks}


def main():
    verb, *words = sys.argv[1:]
    rclpy.init()
    node, found = {"tick": tick, "hear": hear}[verb](*words)
    print(json.dumps({"ready": True}), flush=True)

    def end():
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=end, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
