"""A system that is learned from its capture: each constant, and a twin that loses what the first lost."""

import re

import pytest
from made_system import CONSTANTS, LIMITS, PORTS, STATE, TIME, lost, play, write
from places import ROOT

from edoras_tools.addons.lab.emulator import WireDatagram
from edoras_tools.addons.lab.emulator.cfs import mission_profile, routes_of
from edoras_tools.addons.mission_draft.learn import learn_mission
from edoras_tools.diagnosis import examination
from edoras_tools.errors import CaptureError
from edoras_tools.io import SourceDefaults
from edoras_tools.mission import loads
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.units import MILLISECOND, SECOND

MS_500 = 500 * MILLISECOND


def learned(*paths, rows=0):
    """Return what is learned of captures; ``rows``: of a batch, where that matters."""

    def opened(settings):
        source = open_files(paths)
        return _Parts(source, rows) if rows else source, settings.workbench(source.info, paths)

    return learn_mission(opened, Settings())[""]


class _Parts(SourceDefaults):
    """A source in smaller batches."""

    def __init__(self, source, rows):
        self._source, self._rows = source, rows
        self.info, self.statistics, self.close = source.info, source.statistics, source.close

    def batches(self):
        for batch in self._source.batches():
            for first in range(0, len(batch), self._rows):
                yield batch.take(slice(first, first + self._rows))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The file of the made system, and what it lost with some seeds."""
    folder = tmp_path_factory.mktemp("made")
    path = folder / "system.yaml"
    sent, first = play()
    path.write_text(learned(write(sent, folder / "made.pcap")).text, encoding="utf-8")
    return path, [lost(first), *(lost(play(seed=seed)[1]) for seed in (2, 3))]


def test_each_constant_of_a_made_system_is_learned(made):
    bench = Settings([made[0]]).workbench()
    profile = mission_profile(bench)
    for name, value in (CONSTANTS | PORTS).items():
        assert getattr(profile, name) == pytest.approx(value, rel=0.1), name
    assert profile.to_limits[STATE] == pytest.approx(LIMITS[STATE], rel=0.1)
    assert {*CONSTANTS, *LIMITS} <= profile.stated
    assert [(item.type, item.msg_id, item.envelope) for item in bench.mission.routes] == [
        ("geometry_msgs/msg/Twist", 0x1A01, "2/2 be"),
        ("geometry_msgs/msg/PoseStamped", 0x0A01, "2/2 be"),
    ]
    assert bench.mission.warnings == ()
    assert str(profile.time) == TIME


def test_an_address_that_no_bridge_takes_is_a_comment(tmp_path):
    """The real bridges know IPv4 alone; the file that is learned loads, and says what was seen."""
    sent = [
        item._replace(source=six(item.source), destination=six(item.destination))
        for item in play(seconds=6)[0]
    ]
    text = learned(write(sent, tmp_path / "six.pcap")).text
    assert '      fsw_ip: "0.0.0.0" # fd00::1 was seen, but the bridges take IPv4 only\n' in text
    assert loads({"six.yaml": text.encode()}).ground[0].fsw_port == PORTS["ci_port"]


def six(endpoint):
    """Return the same port at an IPv6 address."""
    return Endpoint("fd00::1", endpoint.port)


def test_a_twin_loses_what_the_first_lost(made):
    path, real = made
    bench = Settings([path]).workbench()
    twins = [lost(play(mission_profile(bench), routes_of(bench), seed=seed)[1]) for seed in (1, 2, 3)]
    for place in range(3):
        first, twin = (sorted(item[place] for item in runs) for runs in (real, twins))
        noise = 1 + first[-1] - first[0]
        assert first[0] - noise <= twin[0]
        assert twin[-1] <= first[-1] + noise


# As tests/captures/README.md has it: rounds of 500 ms, peers of 200 ms, depths and limits; no more is shown.
REAL = {
    "a_rover": ({"ci_wake_ns": MS_500, "to_wake_ns": MS_500, "app_msg_limit": 4}, {}),
    "c3_mqueue10": ({"to_wake_ns": MS_500, "to_pipe_depth": 10}, {0x827: 4}),
    "c4_cmd_rate": (
        {"ci_wake_ns": MS_500, "to_wake_ns": MS_500, "app_msg_limit": 4, "ci_datagrams_per_wake": 11},
        {},
    ),
    "d3_cpu1_cpu2": ({"to_wake_ns": MS_500, "sbn_wake_ns": 200 * MILLISECOND}, {0x828: 4}),
    "season3/q12_to_limits_changed": ({"to_wake_ns": MS_500}, {0x827: 2}),
}
ANY = {"spacecraft_id", "processor_id", "ci_port", "to_port", "sbn_port", "robot_port", "housekeeping_ns"}


def check_others(text):
    """Check that what is known of the other cFS of d3 is there, as comments."""
    others = text.partition("# Of cFS 66:2, for a file of its own:\n")[2]
    assert (
        "#       sbn_msg_limit: 8 # 8 to 8: 49 of 51 rounds behind which some are missing of 0x0828\n"
        in others
    )
    assert all(line.startswith("#") for line in others.splitlines())


@pytest.mark.long("a_rover", "c4*")
@pytest.mark.parametrize("name", REAL)
def test_of_a_real_capture_what_it_shows_and_no_more(name):
    constants, limits = REAL[name]
    draft = learned(ROOT / f"tests/captures/{name}.pcap.zst")
    profile = loads({"system.yaml": draft.text.encode()}).software.profile
    names = {item for item in profile.stated if isinstance(item, str)}
    assert names - ANY == constants.keys()
    assert {item: getattr(profile, item) for item in constants} == constants
    assert {item: profile.to_limits[item] for item in profile.stated - names} == limits
    assert (profile.spacecraft_id, profile.processor_id) == (66, 1)
    if name.startswith("d3"):
        check_others(draft.text)
    if "housekeeping_ns" in names:
        assert profile.housekeeping_ns == SECOND


def profile_of(draft):
    return loads({"system.yaml": draft.text.encode()}).software.profile


def test_chapters_of_a_long_capture_show_one_interval(monkeypatch):
    path = ROOT / "tests/captures/a_rover.pcap.zst"
    whole = learned(path)
    monkeypatch.setattr(examination, "CHAPTER", 600)
    parts = learned(path, rows=100)
    assert profile_of(parts) == profile_of(whole)
    (limit,) = [line for line in parts.text.splitlines() if "app_msg_limit" in line]
    shown = re.fullmatch(
        r" +app_msg_limit: 4 # 4 to 4: (\d+) of (\d+) rounds .* of 0x1827, in 3 chapters", limit
    )
    assert 80 <= int(shown[1]) == int(shown[2]) <= 91


def test_captures_far_apart_are_learned_one_by_one():
    """What any of them shows is there; a limit that was changed between them is the last one's."""
    names = ("c4_cmd_rate", "c3_mqueue10", "season3/q12_to_limits_changed")
    draft = learned(*(ROOT / f"tests/captures/{name}.pcap.zst" for name in names))
    profile = profile_of(draft)
    assert (profile.ci_wake_ns, profile.to_wake_ns, profile.app_msg_limit) == (MS_500, MS_500, 4)
    assert (profile.ci_datagrams_per_wake, profile.to_pipe_depth, profile.to_limits[0x827]) == (11, 10, 2)
    assert "0x0827: 2 # the last command that adds it says so; others show 4\n" in draft.text
    assert "rounds of TO_LAB_APP, in 3 chapters\n" in draft.text


@pytest.mark.parametrize("name", ["n12_two_hosts_flight", "season3/p4_apps_stopped"])
def test_even_times_of_what_is_published_or_let_through_are_no_round(name):
    """15 kbit/s let a message through each 79 ms; the generator publishes at 1 Hz."""
    assert "sbn_wake_ns" not in profile_of(learned(ROOT / f"tests/captures/{name}.pcap.zst")).stated


def test_a_capture_without_cfs_is_refused():
    with pytest.raises(CaptureError, match="nothing of a cFS is in it"):
        learned(ROOT / "samples/rtps/cyclone_sender.pcap.gz")


def test_commands_alone_show_nothing_of_their_cfs(tmp_path):
    source = open_files([ROOT / "samples/captures/a_rover.pcap"])
    sent = [
        WireDatagram(item.time_ns, item.source, item.destination, bytes(item.payload))
        for batch in source.batches()
        for item in batch
        if item.destination.port == 1234
    ]
    draft = learned(write(sent, tmp_path / "commands.pcap"))
    mission = loads({"system.yaml": draft.text.encode()})
    assert [item.msg_id for item in mission.routes] == [0x1827]
    assert (mission.software.profile.stated, mission.software.headers) == (frozenset(), {})
