"""A subscription of our graph over rclpy that follows its publishers, run by the Python that has the wheels.

    python ros_follow.py DISTRIBUTION TOPIC

For each line on its standard input it prints as JSON what it asks for and the numbers heard so far.
"""

import json
import sys

from edoras_tools.middleware import Qos, open_graph
from edoras_tools.middleware.opening import usual_domain
from edoras_tools.ros import TypeStore

STRING = "std_msgs/msg/String"


def main():
    distro, topic = sys.argv[1:]
    types, heard = TypeStore(distro), []
    graph = open_graph("rclpy", types, "follows", domain=usual_domain())
    graph.subscribe(
        topic, STRING, Qos(None, None), lambda cdr: heard.append(int(types.decode(STRING, cdr)["data"]))
    )
    for _ in sys.stdin:
        (qos,) = graph.states()[topic].qos
        print(json.dumps({"asked": [qos.reliable, qos.transient_local], "heard": heard}), flush=True)
    graph.close()


if __name__ == "__main__":
    main()
