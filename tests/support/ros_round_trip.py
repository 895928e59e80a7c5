"""A message of each type through one of our graphs to a real ROS 2 node, ``ros_peer.py``, and back.

    python ros_round_trip.py GRAPH DISTRIBUTION TYPE...

It prints JSON: ``back``, what came back, by type, as CDR in hexadecimal digits; ``sent``, what went out; and
the graph's ``notes``. It ends when its standard input does: until then the peer can see it. The Python that
has the wheels runs it for ``rclpy``, else the tests' own.
"""

import json
import sys
import time
from random import Random

from edoras_tools.middleware import Qos, open_graph
from edoras_tools.middleware.graph import usual_domain
from edoras_tools.pipelines.sending.inject import arbitrary
from edoras_tools.ros import TypeStore

MOST_SECONDS = 120


def topics(name):
    """Return the topics of a type: to the peer, and back."""
    last = name.replace("/", "_")
    return f"/there/{last}", f"/back/{last}"


def main():
    ros, distro, *names = sys.argv[1:]
    types, dice = TypeStore(distro), Random(14)
    graph = open_graph(ros, types, "round_trip", domain=usual_domain())
    sent = {name: types.encode(name, arbitrary(types, name, dice)) for name in names}
    back, publish = {}, {}
    for name in names:
        there, here = topics(name)
        graph.subscribe(here, name, Qos(), lambda cdr, name=name: back.setdefault(name, cdr))
        publish[name] = graph.advertise(there, name, Qos())
    end = time.monotonic() + MOST_SECONDS
    while len(back) < len(names) and time.monotonic() < end:
        for name in names:
            if name not in back:  # until both directions are matched, a message may be lost
                publish[name](sent[name])
        time.sleep(0.05)
    found = {
        "back": {name: cdr.hex() for name, cdr in back.items()},
        "sent": {name: cdr.hex() for name, cdr in sent.items()},
        "notes": graph.notes(),
    }
    print(json.dumps(found), flush=True)
    sys.stdin.read()
    graph.close()


if __name__ == "__main__":
    main()
