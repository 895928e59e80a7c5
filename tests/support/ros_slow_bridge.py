"""A slow bridge of a real ROS 2: it passes Twists on to Command Ingest, as EDORAS's does.

    python ros_slow_bridge.py TOPIC DEPTH NAP PORT

For each message it sleeps NAP seconds. When its standard input ends, it prints as JSON the numbers of
those that it passed on, and how many its event says are lost.
"""

import contextlib
import json
import socket
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import Twist
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile

from edoras_tools.cfs.edoras_app import SET
from edoras_tools.wire import cfe
from edoras_tools.wire.envelope import DEFAULT

CMD_VEL = 0x1827


def main():
    topic, depth, nap, port = sys.argv[1:]
    rclpy.init()
    node = rclpy.create_node("slow_bridge")
    sender, count = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), {"passed_on": [], "event": 0}

    def take(data, info):
        packet = cfe.emit_command(
            CMD_VEL, SET, DEFAULT.emit(bytes(data)), sequence_flags=0, with_checksum=False
        )
        sender.sendto(packet, ("127.0.0.1", int(port)))
        count["passed_on"].append(info["publication_sequence_number"])
        time.sleep(float(nap))

    def lose(status):
        count["event"] = status.total_count

    events, quality = SubscriptionEventCallbacks(message_lost=lose), QoSProfile(depth=int(depth))
    node.create_subscription(Twist, topic, take, quality, event_callbacks=events, raw=True)
    print(json.dumps({"ready": True}), flush=True)

    def end():
        sys.stdin.read()
        rclpy.try_shutdown()

    threading.Thread(target=end, daemon=True).start()
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
    print(json.dumps(count), flush=True)


if __name__ == "__main__":
    main()
