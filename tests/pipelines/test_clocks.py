"""Several captures of one system as one: the same result whatever their clocks say."""

import itertools
import re
from operator import attrgetter

import mutations
import pytest
from effort import every, long_but
from msgspec.structs import replace
from places import CAPTURES, MISSIONS, ROOT
from rewriting import datagrams, write

from edoras_tools.pipelines.clocks import open_aligned
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire.cfe import FILE_HEADER

CONFIG = [MISSIONS / "two_rovers_ground.yaml", MISSIONS / "two_rovers_flight.yaml"]
SBN = {2234, 2235, 2236}
GROUND = "127.0.0.2"
SPLITS = {
    "every other datagram": lambda item, _: item.identification % 2 == 0,
    "by link": lambda item, _: item.destination[1] in SBN,
    "by sender": lambda item, _: item.source[1] != 2235,
    "by what cpu2 and the ground send": lambda item, _: item.source[1] != 2235 and item.source[0] != GROUND,
    "one after the other": lambda item, middle: item.time_ns < middle,
}


def diagnosed(*paths):
    settings = Settings(CONFIG)
    source, notes = open_aligned(paths, settings)
    return examine(source, settings.workbench(source.info)).diagnosis, notes


APART_S = (-1, 0.05, 0, 4)
# In `make test` each way to split has one of the shifts, and each shift is there.
QUICK = list(zip(SPLITS, itertools.cycle(APART_S)))


@pytest.fixture(scope="module")
def traffic():
    (path,) = CAPTURES.glob("d3_cpu1_cpu2.pcap*")
    return datagrams(path)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, traffic):
    """What is found in a capture that nobody split."""
    return totals(diagnosed(write(tmp_path_factory.mktemp("whole") / "c.pcap", traffic))[0])


def totals(found):
    return found.lost, found.superseded, found.unaccounted, found.datagrams


@pytest.mark.quick("by sender-0")
@pytest.mark.parametrize(("split", "seconds"), long_but(QUICK, list(itertools.product(SPLITS, APART_S))))
def test_a_capture_in_two_whose_clocks_differ_loses_the_same(tmp_path, traffic, whole, split, seconds):
    middle = traffic[len(traffic) // 2].time_ns
    first = [item for item in traffic if SPLITS[split](item, middle)]
    second = [item.at(int(seconds * 1e9)) for item in traffic if not SPLITS[split](item, middle)]
    found, notes = diagnosed(write(tmp_path / "a.pcap", first), write(tmp_path / "b.pcap", second))
    assert totals(found) == whole
    if split == "one after the other" and 0 <= seconds < 2:
        assert notes == []  # as files that are written in turn: of one clock
    elif not notes:
        # Of one host and no conversation in both: equal, as nothing tells that they are not.
        assert split != "every other datagram"
        assert abs(seconds) < 0.1
    else:
        low, high = bounds(*notes)
        assert low - 1e-4 <= seconds <= high + 1e-4


ROVERS = {
    # From here to there, who is in the second capture: what came out of cFS says when it went in.
    "a_rover": lambda item: item.destination[1] == 1234,
    "c4_cmd_rate": lambda item: item.destination[1] in {8080, 8585},
    "n3_cfs_restart": lambda item: item.destination[1] == 1234,
    "p6b_extended_header": lambda item: item.destination[1] == 1234,
}


@pytest.mark.long
@pytest.mark.parametrize("name", ROVERS)
def test_what_comes_out_of_cfs_tells_when_it_went_in(tmp_path, name):
    traffic = datagrams(ROOT / f"tests/captures/{name}.pcap.zst")
    path = write(tmp_path / "a.pcap", [item for item in traffic if not ROVERS[name](item)])
    whole, _ = diagnosed(write(tmp_path / "c.pcap", traffic))
    for seconds in (-1, 4):
        moved = [item.at(seconds * 10**9) for item in traffic if ROVERS[name](item)]
        found, (note,) = diagnosed(path, write(tmp_path / "b.pcap", moved))
        low, high = bounds(note)
        assert low - 1e-4 <= seconds <= high + 1e-4
        assert (found.lost, found.unaccounted) == (whole.lost, whole.unaccounted)


@pytest.mark.quick("1")
@pytest.mark.parametrize("order", [1, -1])
def test_two_hosts_that_captured_the_same_are_one(order):
    paths = sorted((ROOT / "tests/captures").glob("n12_two_hosts_*.pcap*"))[::order]
    assert len(paths) == 2
    found, (note,) = diagnosed(*paths)
    assert (found.lost, found.datagrams) == (83, 1358)
    assert "1,307 datagrams are in both" in note
    assert abs(float(note.split(" by ")[1].split()[0])) < 0.005


@pytest.mark.parametrize("turned", [False, True])
def test_files_that_overlap_in_streams_are_one(tmp_path, turned):
    whole = ROOT / "tests/captures/cfs7/two_tcp.pcap.zst"
    traffic = mutations.frames(whole)
    parts = traffic[: len(traffic) * 3 // 5], traffic[len(traffic) // 2 :]
    paths = [mutations.write(tmp_path / f"{at}.pcap", part) for at, part in enumerate(parts)]
    found, _ = diagnosed(*(paths[::-1] if turned else paths))
    assert totals(found) == totals(diagnosed(whole)[0])


@pytest.mark.each(2)
@pytest.mark.parametrize("name", ["a_rover", "c4_cmd_rate", "flights/ci_counters_reset", "flights/starved"])
@pytest.mark.parametrize("late_ms", [0, 50])
def test_captures_of_two_ports_of_a_host_are_judged_together(tmp_path, name, late_ms):
    path = ROOT / f"tests/captures/{name}.pcap.zst"
    whole, parts = diagnosed(path)[0], ([], [])
    for item in mutations.frames(path):
        down = mutations.is_to(item.data, 1235)
        parts[down].append(item._replace(time_ns=item.time_ns + late_ms * 10**6 * down))
    up, down = (mutations.write(tmp_path / f"{at}.pcap", part) for at, part in enumerate(parts))
    found, (note,) = diagnosed(up, down)
    assert "1.pcap: its clock is assumed to be that of" in note
    assert totals(found)[:3] == totals(whole)[:3]


@pytest.mark.long
def test_captures_that_have_nothing_in_common_are_not_aligned(tmp_path, traffic):
    commands = [
        replace(item, source=("10.9.0.1", 1235), destination=("10.9.0.2", 1234))
        for item in traffic
        if item.destination[1] == 1234
    ]
    rest = [item for item in traffic if item.destination[1] != 1234]
    path, alone = write(tmp_path / "a.pcap", rest), diagnosed(write(tmp_path / "c.pcap", rest))[0].lost
    for seconds in every(2, (-1, 0, 4)):
        other = write(tmp_path / "b.pcap", [item.at(seconds * 10**9) for item in commands])
        found, (note,) = diagnosed(path, other)
        assert "its clock cannot be compared with that of" in note
        # Each is judged by itself: nothing is concluded from which came first.
        assert (found.lost, found.unaccounted) == (alone, 0)
        assert found.datagrams == len(traffic)


def drifting(items, ppm, seconds):
    """Captured by a clock that is ahead at the first of them, and gains on the other one."""
    first = items[0].time_ns
    return [item.at(round((item.time_ns - first) * ppm / 1e6) + round(seconds * 1e9)) for item in items]


BOUNDS = re.compile(r"is (ahead of|behind) that of .* by [\d.]+ s.*?, (-?[\d.]+) to (-?[\d.]+) s,")


def bounds(note):
    """The least and the most that a clock is ahead, in s."""
    way, low, high = BOUNDS.search(note).groups()
    return (float(low), float(high)) if way == "ahead of" else (-float(high), -float(low))


DRIFT = re.compile(r"by ([+-][\d.]+) ppm, between ([+-][\d.]+) and ([+-][\d.]+) ppm")


@pytest.mark.each(3)
@pytest.mark.quick("0-0-1", "-100-0.3-1", "200-4--1")
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("ppm", "seconds"), [(0, 0), (20, -1), (-100, 0.3), (200, 4)])
def test_the_drift_of_two_hosts_clocks_is_told_and_taken_out(tmp_path, order, ppm, seconds):
    paths = sorted((ROOT / "tests/captures").glob("n12_two_hosts_*.pcap*"))[::order]
    moved = write(tmp_path / "b.pcap", drifting(datagrams(paths[1]), ppm, seconds))
    found, (note,) = diagnosed(paths[0], moved)
    assert (found.lost, found.superseded, found.unaccounted, found.datagrams) == (83, 132, 0, 1358)
    told, low, high = map(float, DRIFT.search(note).groups())
    assert low <= ppm <= high <= low + 1
    assert abs(told - ppm) < 1
    low, high = bounds(note)
    assert low <= seconds <= high <= low + 0.005


@pytest.mark.long
@pytest.mark.parametrize("ppm", [20, -200])
def test_the_drift_between_parts_of_streams_is_told_by_their_counts(tmp_path, traffic, ppm):
    split = SPLITS["every other datagram"]
    path = write(tmp_path / "a.pcap", [item for item in traffic if split(item, 0)])
    other = drifting([item for item in traffic if not split(item, 0)], ppm, 0.05)
    found, (note,) = diagnosed(path, write(tmp_path / "b.pcap", other))
    assert (found.lost, found.unaccounted, found.datagrams) == (6601, 0, len(traffic))
    _, low, high = map(float, DRIFT.search(note).groups())
    assert low <= ppm <= high <= low + 1


@pytest.mark.long
def test_a_drift_that_order_alone_cannot_show_is_not_claimed(tmp_path, traffic):
    split = SPLITS["by link"]
    path = write(tmp_path / "a.pcap", [item for item in traffic if split(item, 0)])
    other = drifting([item for item in traffic if not split(item, 0)], 100, 0)
    found, notes = diagnosed(path, write(tmp_path / "b.pcap", other))
    assert notes == []  # of one host: their clocks may be equal
    assert (found.lost, found.unaccounted) == (6601, 0)


@pytest.mark.long
def test_a_third_capture_is_aligned_by_the_one_it_shares_packets_with(tmp_path):
    flight = datagrams(ROOT / "tests/captures/n12_two_hosts_flight.pcap.zst")
    commands = [item for item in flight if item.destination[1] == 1234]
    rest = [item.at(3_000_000_000) for item in flight if item.source[1] == 2236]
    first, third = write(tmp_path / "a.pcap", commands), write(tmp_path / "c.pcap", rest)
    assert "its clock cannot be compared" in diagnosed(first, third)[1][0]
    second = write(tmp_path / "b.pcap", [item.at(-1_000_000_000) for item in flight])
    found, notes = diagnosed(first, second, third)
    assert "behind that of" in notes[0]
    assert f"ahead of that of {second} by 4.000 s" in notes[1]
    whole, _ = diagnosed(write(tmp_path / "d.pcap", flight))
    assert (found.lost, found.datagrams) == (whole.lost, whole.datagrams)


def test_a_third_capture_goes_by_the_packets_it_shares_not_by_the_first(tmp_path):
    hosts = [
        datagrams(ROOT / f"tests/captures/n12_two_hosts_{side}.pcap.zst") for side in ("flight", "ground")
    ]
    sbn = {True: [], False: []}
    for item in hosts[0]:
        sbn[2236 in (item.source[1], item.destination[1])].append(item)
    inside, flight = write(tmp_path / "a.pcap", sbn[True]), write(tmp_path / "b.pcap", sbn[False])
    ground = [item for item in hosts[1] if 2236 not in (item.source[1], item.destination[1])]
    _, notes = diagnosed(inside, flight, write(tmp_path / "c.pcap", ground))
    assert any(f"that of {flight} by" in note for note in notes)


@pytest.mark.parametrize("boot", [0, 1])
@pytest.mark.parametrize("same", [True, False], ids=["its packets are captured", "others of it"])
def test_a_file_of_a_cfs_is_put_on_its_own_boot_or_on_none(tmp_path, boot, same):
    """Of n3, whose cFS was started twice: both boots have packets at every mission time of the file."""
    capture = ROOT / "tests/captures/n3_cfs_restart.pcap.zst"
    sent = [item for item in datagrams(capture) if item.destination[1] == 1235]
    again = next(at for at in range(1, len(sent)) if sent[at].time_ns - sent[at - 1].time_ns > 5 * 10**9)
    kept = (sent[:again], sent[again:])[boot][:5]
    # A byte of cFE's spare ones makes them packets that nobody captured.
    packets = [item.payload if same else item.payload[:15] + b"\1" + item.payload[16:] for item in kept]
    path = tmp_path / "stored.log"
    header = (ROOT / "samples/cfs_files/events.log").read_bytes()[: FILE_HEADER.size]
    path.write_bytes(header + b"".join(packets))
    source, (note,) = open_aligned([capture, path], Settings())
    placed = [item.time_ns for batch in source.batches() for item in batch if item.source.port == 0]
    if same:
        assert "measured by the mission time of one cFS in both" in note
        assert placed[0] == pytest.approx(kept[0].time_ns, abs=10**9)
    else:
        assert "not placed" in note
        assert "was started 2 times there, which fit equally" in note
        assert max(placed) < min(item.time_ns for item in kept) - 10**18


@pytest.mark.quick("True")
@pytest.mark.parametrize("turned", [False, True])
def test_boots_in_two_files_that_follow_each_other_are_of_one_clock(tmp_path, turned):
    traffic = datagrams(ROOT / "tests/captures/n3_cfs_restart.pcap.zst")
    begin_ns = traffic[0].time_ns
    parts = [
        [item for item in traffic if (item.time_ns < begin_ns + 21 * 10**9) == first]
        for first in (True, False)
    ]
    paths = [write(tmp_path / f"{at}.pcap", part) for at, part in enumerate(parts)]
    found, notes = diagnosed(*(paths[::-1] if turned else paths))
    assert notes == []
    assert totals(found) == totals(diagnosed(write(tmp_path / "whole.pcap", traffic))[0])


@pytest.mark.parametrize("order", ["012", "201", "210"])
def test_files_written_in_turn_are_of_one_clock_though_mission_time_wanders(tmp_path, order):
    whole = ROOT / "tests/captures/season3/q25_robot_off_then_bridge_off.pcap.zst"
    traffic = mutations.frames(whole)
    third = len(traffic) // 3
    parts = traffic[:third], traffic[third : 2 * third], traffic[2 * third :]
    paths = [mutations.write(tmp_path / f"{at}.pcap", part) for at, part in enumerate(parts)]
    found, notes = diagnosed(*(paths[int(at)] for at in order))
    assert notes == []
    assert found.balance == diagnosed(whole)[0].balance


@pytest.mark.parametrize(("number", "sure"), [(3, False), (40, True)])
def test_what_the_other_host_lacks_it_may_have_missed_unless_that_is_too_much(tmp_path, number, sure):
    flight = mutations.frames(ROOT / "tests/captures/flights/sender_that_counts.pcap.zst")
    down = [at for at, item in enumerate(flight) if mutations.is_to(item.data, 1235)]
    gone = set(down[100 : 100 + number])
    way = {True: 5_000_000, False: -5_000_000}
    ground = [
        item._replace(time_ns=item.time_ns + way[mutations.is_to(item.data, 1235)])
        for at, item in enumerate(flight)
        if at not in gone
    ]
    ground.sort(key=attrgetter("time_ns"))
    found, _ = diagnosed(
        mutations.write(tmp_path / "ground.pcap", ground), mutations.write(tmp_path / "flight.pcap", flight)
    )
    assert (found.lost, found.uncertain) == ((17 + number, 0) if sure else (17, number))
