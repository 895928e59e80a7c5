"""A node of a real ROS 2, run by the Python that has its wheels: it does what lines of JSON say, in order.

    {"speak": TOPIC, "reliable": true, "transient_local": false, "depth": 10}   a publisher
    {"hush": TOPIC}                                                             without it
    {"hear": TOPIC, ...}                                                        a subscription
    {"say": [TOPIC...], "from": 0, "to": 160, "rate": 2000}   the numbers, on each topic, so many a second
    {"ask": true}            what was heard by topic, how many rclpy says were lost, and who the partners are

All messages are ``std_msgs/msg/String``. Each line is answered by one, once it is done.
"""

import json
import os
import sys
import threading
import time
from collections import defaultdict

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String


class Talk:
    """What the node has, by topic."""

    def __init__(self):
        rclpy.init()
        self.node = rclpy.create_node("talk")
        self.publishers, self.subscriptions, self.lost = {}, {}, {}
        self.heard = defaultdict(list)
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def speak(self, topic, **qos):
        self.publishers[topic] = self.node.create_publisher(String, topic, profile(**qos))

    def hush(self, topic):
        self.node.destroy_publisher(self.publishers.pop(topic))

    def hear(self, topic, **qos):
        def take(message):
            self.heard[topic].append(message.data)

        def count(status):
            self.lost[topic] = status.total_count

        events = SubscriptionEventCallbacks(message_lost=count, use_default_callbacks=False)
        self.subscriptions[topic] = self.node.create_subscription(
            String, topic, take, profile(**qos), event_callbacks=events
        )

    def say(self, topics, *, rate=0, **numbers):
        began, count = time.monotonic(), 0
        for number in range(numbers["from"], numbers["to"]):
            for topic in topics:
                self.publishers[topic].publish(String(data=str(number)))
                count += 1
                if rate and (early := began + count / rate - time.monotonic()) > 0:
                    time.sleep(early)

    def ask(self, _):
        return {
            "heard": dict(self.heard),
            "lost": self.lost,
            "subscriptions": {
                topic: item.get_subscription_count() for topic, item in self.publishers.items()
            },
            "publishers": {topic: self.node.count_publishers(topic) for topic in self.subscriptions},
            "infos": {
                topic: [
                    (item.qos_profile.reliability.name, item.qos_profile.durability.name)
                    for item in self.node.get_subscriptions_info_by_topic(topic)
                ]
                for topic in self.publishers
            },
        }


def profile(reliable=True, transient_local=False, depth=10):
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if transient_local else DurabilityPolicy.VOLATILE,
    )


def main():
    talk = Talk()
    print("{}", flush=True)
    for line in sys.stdin:
        order = json.loads(line)
        word = next(iter(order))
        print(json.dumps(getattr(talk, word)(order.pop(word), **order) or {}), flush=True)
    sys.stdout.flush()
    os._exit(0)  # a thread of rclpy's waits for ever


if __name__ == "__main__":
    main()
