"""Nodes of a real ROS 2, run by the Python that has its wheels: one that publishes, one that counts.

    python ros_counts.py talk TOPIC TYPE COUNT HZ DEPTH SUBSCRIPTIONS
    python ros_counts.py hear TOPIC DEPTH NAP

``talk`` waits until so many subscriptions match, publishes TYPE, Twist or TwistStamped whose stamps are
0.1 s old, and prints as JSON when it published each. ``hear`` sleeps NAP seconds for each message; when its
standard input ends, it prints when each came, its bytes and age, how many its event says are lost, and their
numbers.
"""

import contextlib
import json
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist, TwistStamped
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message

AGE_NS = 100_000_000
KINDS = {"Twist": Twist, "TwistStamped": TwistStamped}


def talk(topic, kind, count, hertz, depth, subscriptions):
    node = rclpy.create_node("talker")
    publisher = node.create_publisher(KINDS[kind], topic, QoSProfile(depth=int(depth)))
    while publisher.get_subscription_count() < int(subscriptions):
        time.sleep(0.02)
    print(json.dumps({"matched": True}), flush=True)
    start, times = time.monotonic() + 0.5, []
    for number in range(int(count)):
        time.sleep(max(0, start + number / float(hertz) - time.monotonic()))
        message, now = TwistStamped(), time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now - AGE_NS, 10**9)
        message.twist.linear.x = number / 8
        times.append(now)
        publisher.publish(message if kind == "TwistStamped" else message.twist)
    print(json.dumps({"published": times}), flush=True)
    sys.stdin.read()


def hear(topic, depth, nap):
    node = rclpy.create_node("listener")
    times, sizes, ages, numbers, lost = [], [], [], [], [0]

    def take(data, info):
        now = info["received_timestamp"]
        stamp = deserialize_message(data, TwistStamped).header.stamp
        times.append(now)
        sizes.append(len(data))
        ages.append(now - stamp.sec * 10**9 - stamp.nanosec)
        numbers.append(info["publication_sequence_number"])
        time.sleep(float(nap))

    def lose(status):
        lost[0] = status.total_count

    events = SubscriptionEventCallbacks(message_lost=lose)
    quality = QoSProfile(depth=int(depth))
    node.create_subscription(TwistStamped, topic, take, quality, event_callbacks=events, raw=True)
    print(json.dumps({"ready": True}), flush=True)

    def end():
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=end, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
    counted = {"times": times, "sizes": sizes, "ages": ages, "numbers": numbers, "lost": lost[0]}
    print(json.dumps(counted), flush=True)


def main():
    verb, *words = sys.argv[1:]
    rclpy.init()
    {"talk": talk, "hear": hear}[verb](*words)


if __name__ == "__main__":
    main()
