"""A recording to a graph that keeps what is published: what, when, with which quality of service."""

import time

import pytest
from mcap.writer import Writer
from places import SAMPLES

from edoras_tools.addons.ros_verbs.playing import CLOCK, PlayRequest, load_messages, play
from edoras_tools.errors import CaptureError, WireError
from edoras_tools.middleware.graph import Qos
from edoras_tools.pipelines.messages import open_inputs
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore

TYPES, STRING, START = TypeStore(), "std_msgs/msg/String", 1_790_000_000 * 10**9
PROFILE = "- history: keep_last\n  depth: {}\n  reliability: {}\n  durability: {}\n"


class Kept:
    """A graph of one subscription to each topic."""

    def __init__(self, refuses=()):
        self.qos, self.rows, self.refuses, self.closed = {}, [], refuses, False

    def advertise(self, topic, type_name, qos):
        self.qos[topic] = type_name, qos

        def publish(cdr):
            if topic in self.refuses:
                raise WireError(f"{topic}: no")
            self.rows.append((time.monotonic(), topic, cdr))

        return publish

    def subscribers(self, topic):
        return len(topic) and 1

    def notes(self):
        return []

    def close(self):
        self.closed = True


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Thirty Strings in 0.29 s, and one that is latched."""
    path = tmp_path_factory.mktemp("play") / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema(STRING, "ros2msg", TYPES.definition(STRING).encode())

        def channel(topic, *profile):
            return writer.register_channel(
                topic, "cdr", schema, {"offered_qos_profiles": PROFILE.format(*profile)}
            )

        said, chart = (
            channel("/said", 7, "best_effort", "volatile"),
            channel("/map", 1, "reliable", "transient_local"),
        )
        writer.add_message(chart, START, TYPES.encode(STRING, {"data": "map"}), START)
        for number in range(30):
            at = START + number * 10_000_000
            writer.add_message(said, at, TYPES.encode(STRING, {"data": str(number)}), at)
        writer.finish()
    return path


def run(path, graph=None, settings=None, **options):
    source, bench = open_inputs([path], settings or Settings())
    options, graph = PlayRequest(**options), graph or Kept()
    loaded = load_messages(source, bench, options)
    return graph, play(loaded, graph, options, bench.mission, name="kept")


def test_all_in_order_at_their_times_with_their_quality_of_service(bag):
    graph, report = run(bag)
    assert graph.closed
    assert graph.qos == {
        "/map": (STRING, Qos(True, True, 1)),
        "/said": (STRING, Qos(False, False, 7)),
    }
    texts = [TYPES.decode(STRING, cdr)["data"] for _, topic, cdr in graph.rows if topic == "/said"]
    assert texts == [str(number) for number in range(30)]
    times = [at for at, topic, _ in graph.rows if topic == "/said"]
    assert times[-1] - times[0] >= 0.28
    assert report.sent == report.total == 31


def test_the_clock_is_the_recordings_time(bag):
    graph, report = run(bag, clock_hz=100.0, speed=4.0)
    ticks = [
        TYPES.decode(graph.qos[CLOCK][0], cdr)["clock"] for _, topic, cdr in graph.rows if topic == CLOCK
    ]
    shown = [tick["sec"] * 10**9 + tick["nanosec"] - START for tick in ticks]
    assert shown == [number * 40_000_000 for number in range(8)]  # four times as fast: 40 ms each
    assert [topic for _, topic, _ in graph.rows][:3] == [CLOCK, "/map", "/said"]
    assert report.sent == 31 + 8


@pytest.mark.parametrize(
    ("options", "names", "count"),
    [
        ({"topics": ["/m*"]}, {"/map"}, 1),
        ({"rename": {"/map": "/chart"}}, {"/said", "/chart"}, 31),
        ({"passes": 2, "speed": 9.0}, {"/said", "/map"}, 62),
    ],
)
def test_a_part_under_another_name_and_again(bag, options, names, count):
    graph, report = run(bag, **options)
    assert (graph.qos.keys(), report.sent) == (names, count)


def test_what_is_refused_is_counted(bag):
    _, report = run(bag, Kept(refuses=("/map",)), speed=50.0)
    assert (report.sent, report.errors) == (30, {"/map: no": 1})


def test_a_capture_is_played_by_its_mission():
    settings = Settings([SAMPLES / "missions/rover_ground.yaml"])
    graph, _ = run(SAMPLES / "captures/a_rover.pcap", settings=settings, topics=["/cmd_vel"], speed=1000.0)
    assert graph.qos == {"/cmd_vel": ("geometry_msgs/msg/Twist", Qos())}
    assert len(graph.rows) == 600


def test_nothing_to_play_is_one_line(bag):
    with pytest.raises(CaptureError, match="it has no ROS message that was selected"):
        run(bag, topics=["/nothing"])
