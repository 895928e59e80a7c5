"""A graph as a source, over an observer that a test fills: numbers, losses, and a recording of them."""

import msgspec
import pytest
from mcap.reader import make_reader

from edoras_tools.addons.ros_verbs import endpoints as module
from edoras_tools.addons.ros_verbs.endpoints import GraphRequest, open_source, topics_of_graph
from edoras_tools.addons.runs.comparison import missed_by
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.rosbag2.reader import open_rosbag
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore

TYPES, STRING, MS = TypeStore(), "std_msgs/msg/String", 10**6
FOREVER = (1 << 63) - 1
POLICIES = {
    "Reliability": "RELIABLE",
    "History (Depth)": "UNKNOWN",
    "Durability": "VOLATILE",
    "Lifespan": FOREVER,
    "Deadline": FOREVER,
    "Liveliness": "AUTOMATIC",
    "Liveliness lease duration": FOREVER,
}


class Observed:
    """An observer of endpoints that a test names; messages come when one is observed."""

    def __init__(self, messages=(), lost=0):
        self.ends, self.qos, self.closed = [], {}, False
        self._messages, self._lost = messages, lost

    def end(self, topic, gid, node="/talker", kind=STRING, publishes=True, own=False, **policies):
        known = {"topic": topic, "type": kind, "publishes": publishes, "gid": gid, "node": node, "own": own}
        self.ends.append({**known, "policies": POLICIES | policies, "type_hash": ""})
        return self

    def described(self):
        return self.ends

    def observe(self, topic, type_name, qos, heard):
        self.qos[topic] = qos
        for item in self._messages:
            if item[0] == topic:
                heard(*item[1:])

    def lost(self):
        return dict.fromkeys(self.qos, self._lost)

    def close(self):
        self.closed = True


@pytest.fixture
def looking(monkeypatch):
    monkeypatch.setattr(module, "_DISCOVERY_S", 0.01)

    def look(observer, *topics):
        monkeypatch.setattr(module, "open_observer", lambda *_: observer)
        notes = []
        request = GraphRequest("rclpy", 3, topics=topics, on_note=notes.append)
        return request, notes

    return look


def said(topic, number, sequence, gid="aa", late=2 * MS):
    at = 1_790_000_000 * 10**9 + number * 10 * MS
    return topic, TYPES.encode(STRING, {"data": str(number)}), at + late, at, sequence, gid


def read(source):
    source.stop()
    return list(source.batches())


@pytest.mark.parametrize(
    ("sequences", "gids", "expected"),
    [
        ([1, 2, 3], ["aa"] * 3, {"aa": (3, 1, 3, 0)}),
        ([5, 6, 9, 10, 20], ["aa"] * 5, {"aa": (5, 5, 20, 11)}),
        ([1, 7, 2, 9], ["aa", "bb", "aa", "bb"], {"aa": (2, 1, 2, 0), "bb": (2, 7, 9, 1)}),
        ([0, 0, 0], ["aa"] * 3, {"aa": (3, None, None, None)}),
        ([4, 6], ["", ""], {"": (2, None, None, None)}),
    ],
)
def test_each_publisher_has_its_own_numbers(looking, sequences, gids, expected):
    messages = [said("/a", at, *item) for at, item in enumerate(zip(sequences, gids, strict=True))]
    observer = Observed(messages).end("/a", "aa").end("/a", "bb", "/other")
    source, _ = open_source(looking(observer, "/a")[0], Settings())
    read(source)
    (topic,) = source.summaries()
    names = ("received", "first_sequence", "last_sequence", "missed")
    found = {item["gid"] or "": tuple(item[name] for name in names) for item in topic["publishers"]}
    assert {gid: row for gid, row in found.items() if row[0]} == expected


def test_what_nobody_claims_is_of_the_only_publisher(looking):
    observer = Observed([said("/a", at, at + 1, "") for at in range(4)]).end("/a", "aa")
    source, _ = open_source(looking(observer, "/a")[0], Settings())
    read(source)
    (publisher,) = source.summaries()[0]["publishers"]
    assert (publisher["node"], publisher["received"], publisher["last_sequence"]) == ("/talker", 4, 4)
    assert publisher["delay_us"] == {"p50": 2000.0, "p99": 2000.0, "max": 2000.0}


def test_a_topic_is_waited_for_no_longer_than_the_duration(looking):
    observer = Observed().end("/a", "aa")
    request, notes = looking(observer, "/a", "/b")
    with pytest.raises(ConfigError, match="not published within --duration: /b"):
        open_source(msgspec.structs.replace(request, duration_ns=200 * MS), Settings())
    assert notes == ["not published yet, waiting: /b; Ctrl-C ends"]
    assert observer.closed


def test_who_left_stays_and_who_does_not_match_is_named(looking):
    observer = Observed([said("/a", 0, 1)], lost=3).end("/a", "aa").end("/a", "cc", "/old", publishes=False)
    observer.end("/a", "dd", "/strict", publishes=False, Durability="TRANSIENT_LOCAL")
    source, _ = open_source(looking(observer, "/a")[0], Settings())
    del observer.ends[0]
    read(source)
    (topic,) = source.summaries()
    assert [item["left"] for item in topic["publishers"]] == [True]
    assert topic["lost"] == 3
    observer.end("/a", "aa")
    source._look()
    apart = {item["node"]: item["incompatible"] for item in source.summaries()[0]["subscriptions"]}
    assert apart == {"/old": [], "/strict": ["/talker: durability"]}


def test_a_recording_is_a_witness_of_what_it_missed(looking, tmp_path):
    messages = [said("/a", at, sequence) for at, sequence in enumerate([1, 2, 6, 7])]
    source, bench = open_source(looking(Observed(messages).end("/a", "aa"), "/a")[0], Settings())
    source.stop()
    path = tmp_path / "seen.mcap"
    record(source, bench, Target(path))
    assert missed_by(open_rosbag(path), TYPES) == {"/a": 3}
    with path.open("rb") as file:
        kept = list(make_reader(file).iter_messages("/a"))
    rows = [(item.sequence, item.log_time - item.publish_time) for *_, item in kept]
    (channel,) = {item[1].metadata["offered_qos_profiles"] for item in kept}
    assert rows == [(1, 2 * MS), (2, 2 * MS), (6, 2 * MS), (7, 2 * MS)]
    assert "reliability: reliable" in channel


def test_without_names_all_that_is_published_is_observed(looking):
    observer = Observed().end("/a", "aa").end("/rosout", "bb").end("/heard", "cc", publishes=False)
    request, notes = looking(observer.end("/odd", "dd", kind="no_msgs/msg/No"))
    source, bench = open_source(request, Settings())
    assert list(source.topics) == ["/a"]
    assert [route.topic for route in bench.mission.routes] == ["/a", "/edoras/graph"]
    assert notes == [f"/odd is left out: {TYPES.check('no_msgs/msg/No')}"]
    source.close()
    assert observer.closed


def test_a_graph_without_topics_is_one_line(looking):
    observer = Observed()
    with pytest.raises(ConfigError, match=r"rclpy, domain 3: no topic is published .* ROS_DOMAIN_ID"):
        open_source(looking(observer)[0], Settings())
    assert observer.closed


def test_the_topics_of_a_graph_without_our_own(looking):
    observer = Observed().end("/a", "aa").end("/a", "bb", publishes=False).end("/b", "cc", own=True)
    (row,) = topics_of_graph(looking(observer)[0], Settings())
    assert (row["topic"], row["type"], row["publishers"], row["subscriptions"]) == ("/a", STRING, 1, 1)
    assert row["details"]["subscriptions"][0].startswith("Node name: talker\n")
