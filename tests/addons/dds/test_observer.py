"""The observer beside a node of ours in another process: endpoints, samples, who left."""

import subprocess
import sys
import time

import pytest

from edoras_tools.addons.dds.observer import dds_observer
from edoras_tools.middleware.graph import Qos
from edoras_tools.ros import TypeStore

pytestmark = pytest.mark.own_network
TYPES, STRING = TypeStore(), "std_msgs/msg/String"
NODE = """
import sys
from edoras_tools.addons.dds.graph import open_graph
from edoras_tools.middleware.graph import Qos
from edoras_tools.ros import TypeStore
types = TypeStore()
graph = open_graph(types, "/robot/talker", domain=39, options={"interface": "lo"})
publish = graph.advertise("/said", "std_msgs/msg/String", Qos(True, True, 5))
graph.subscribe("/heard", "std_msgs/msg/String", Qos(reliable=False), print)
publish(types.encode("std_msgs/msg/String", {"data": "hello"}))
sys.stdin.read()
graph.close()
"""


@pytest.fixture
def observer():
    observer = dds_observer(TYPES, "unused", domain=39, options={"interface": "lo"})
    yield observer
    observer.close()
    observer.close()


def test_who_is_there_and_what_comes(observer, until):
    node = subprocess.Popen([sys.executable, "-c", NODE], stdin=subprocess.PIPE)

    def ends():
        return {item["topic"]: item for item in observer.described() if not item["own"]}

    until(lambda: [item["node"] for item in ends().values()] == ["/robot/talker"] * 2)
    said, heard = ends()["/said"], ends()["/heard"]
    assert (said["type"], said["publishes"], heard["publishes"]) == (STRING, True, False)
    assert (said["policies"]["Reliability"], said["policies"]["Durability"]) == (
        "RELIABLE",
        "TRANSIENT_LOCAL",
    )
    assert (heard["policies"]["Reliability"], heard["policies"]["Durability"]) == ("BEST_EFFORT", "VOLATILE")
    assert said["type_hash"].startswith("RIHS01_")
    rows = []
    observer.observe("/said", STRING, Qos(True, True, 1000), lambda *row: rows.append(row))
    until(lambda: rows)
    message, received_ns, source_ns, sequence, gid = rows[0]
    assert TYPES.decode(STRING, message) == {"data": "hello"}
    assert (sequence, gid) == (0, said["gid"])
    assert 0 < source_ns <= received_ns <= time.time_ns()
    assert observer.lost() == {"/said": 0}
    node.communicate()
    until(lambda: not ends())
