"""A subscription of a graph of ours that follows its publishers.

    python ros_follow.py GRAPH DISTRIBUTION TOPIC

For each line on its standard input it prints as JSON what it asks for, the numbers heard so far, how many
are missed, and what the kernel dropped. The Python that has the wheels runs it for ``rclpy``, else the tests'
own.
"""

import json
import sys

from edoras_tools.middleware import Qos, open_graph
from edoras_tools.middleware.graph import usual_domain
from edoras_tools.ros import TypeStore

STRING = "std_msgs/msg/String"


def main():
    ros, distro, topic = sys.argv[1:]
    types, heard = TypeStore(distro), []
    graph = open_graph(ros, types, "follows", domain=usual_domain())
    graph.subscribe(
        topic, STRING, Qos(None, None), lambda cdr: heard.append(int(types.decode(STRING, cdr)["data"]))
    )
    for _ in sys.stdin:
        state = graph.states()[topic]
        asked = [[qos.reliable, qos.transient_local] for qos in state.qos]
        print(
            json.dumps({"asked": asked, "heard": heard, "missed": state.missed, "dropped": graph.dropped()}),
            flush=True,
        )
    graph.close()


if __name__ == "__main__":
    main()
