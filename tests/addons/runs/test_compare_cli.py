"""``edoras compare``: its exit codes and what it prints."""

from __future__ import annotations

import json
import struct
from io import StringIO
from itertools import count
from xml.etree.ElementTree import parse

import pytest
from msgspec.structs import replace
from places import CAPTURES, MISSIONS, ROOT
from rewriting import datagrams, write
from rich.console import Console
from schema import held
from typer.testing import CliRunner

from edoras_tools.addons.runs.views import runs_view
from edoras_tools.cli.main import program
from edoras_tools.render.severity import Level
from edoras_tools.units import SECOND

ROVER = CAPTURES / "a_rover.pcap"
MISSION = MISSIONS / "rover_ground.yaml"
MARKS = [level.mark for level in Level]


@pytest.fixture(scope="module")
def compare():
    made = program("compare")

    def call(*words):
        return CliRunner().invoke(made, ["compare", *map(str, words)])

    return call


def test_a_run_beside_itself(compare):
    done = compare(ROVER, ROVER, "-c", MISSION, "--max-loss", "16%", "--max-delay", "0x0827=1s")
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "The second run is no worse.")
    assert not [line for line in done.stdout.splitlines() if line.startswith(tuple(MARKS))]


def test_a_worse_run(compare):
    done = compare(CAPTURES / "b_arm_single.pcap", ROVER, "--json")
    assert done.exit_code == 3
    told = json.loads(done.stdout)
    assert (told["schema"], told["worse"], told["bad"]["lost"]) == (1, True, 92)
    assert [item["worse"] for item in told["changes"]] == sorted(
        (item["worse"] for item in told["changes"]), reverse=True
    )
    assert {"verdict", "lost"} <= {item["what"] for item in told["changes"] if item["worse"]}


@pytest.mark.long
@pytest.mark.parametrize("name", ["a_rover", "f_sbn_disconnect", "n1_to_remove_all", "n12_two_hosts_ground"])
def test_a_capture_beside_itself_has_no_difference(compare, name):
    path = ROOT / f"tests/captures/{name}.pcap.zst"
    done = compare(path, path, "--json")
    assert (done.exit_code, json.loads(done.stdout)["changes"]) == (0, [])


def msg_id(item):
    return int.from_bytes(item.payload[:2], "big")


def later(items):
    return [item.at(86_400 * SECOND) for item in items]


def moved(items):
    other = {"127.0.0.1": "10.0.0.1"}
    return [
        replace(
            item,
            source=(other.get(item.source[0], "10.0.0.2"), item.source[1]),
            destination=(other.get(item.destination[0], "10.0.0.2"), item.destination[1]),
        )
        for item in items
    ]


def twice(items):
    return [copy for item in items for copy in (item, item.at(1000))]


def without(number, every):
    def change(items):
        left = count()
        return [item for item in items if msg_id(item) != number or next(left) % every]

    return change


def stopped(items):
    until_ns = items[0].time_ns + 40 * SECOND
    return [item for item in items if msg_id(item) != 0x827 or item.time_ns < until_ns]


def slow(items):
    turn = count()
    late = [item.at(SECOND // 10 * (next(turn) % 2)) if msg_id(item) == 0x827 else item for item in items]
    return sorted(late, key=lambda item: item.time_ns)


CHANGES = {
    # What is done to the second capture, and what of it is worse: kind of the change, MsgId.
    # A rate is that of what was published, from the first to the last: no loss and no end makes it lower.
    later: set(),
    moved: set(),
    twice: set(),
    without(0x827, 1): {("route", "0x0827")},
    without(0x827, 9): {("lost", "0x0827"), ("verdict", "0x0827")},
    # The counters of the software bus go on: which commands they mean is no longer there.
    without(0x1827, 2): {("rate_hz", "0x1827"), ("lost", None), ("verdict", None)},
    stopped: {("verdict", "0x0827")},
    slow: {("latency_ms", "0x0827")},
}


@pytest.mark.each(2)
@pytest.mark.quick("change0", "moved")
@pytest.mark.parametrize("change", CHANGES, ids=lambda item: item.__name__)
def test_a_doctored_capture_is_worse_where_it_was_changed(compare, tmp_path, change):
    items = datagrams(ROOT / "tests/captures/a_rover.pcap.zst")
    good, bad = write(tmp_path / "good.pcap", items), write(tmp_path / "bad.pcap", change(items))
    worse = CHANGES[change]
    done, back = compare(good, bad, "--json"), compare(bad, good, "--json")
    told = json.loads(done.stdout)["changes"]
    assert {(item["what"], item["msg_id"]) for item in told if item["worse"]} == worse
    assert done.exit_code == (3 if worse else 0)
    if ("lost", None) not in worse:
        assert back.exit_code == 0
    assert bool(json.loads(back.stdout)["changes"]) == bool(told)


def test_a_file_that_is_not_there(compare, tmp_path):
    done = compare(ROVER, tmp_path / "none.pcap")
    assert done.exit_code != 0
    assert "there is no such file" in str(done.exception) + done.output


@pytest.mark.long
@pytest.mark.parametrize("name", ["a_rover", "d3_cpu1_cpu2", "f2_sbn_announce_reload", "n10_uplink_loss"])
def test_json_holds_to_its_schema(compare, name):
    path = ROOT / f"tests/captures/{name}.pcap.zst"
    for runs in ((ROVER, path), (path, ROVER)):
        done = compare(*runs, "-c", MISSION, "--json")
        told = json.loads(done.stdout)
        held(told, ["compare", "--json"])
        assert done.exit_code == 3 * told["worse"]


def ninefold(items):
    """Every command 9.0 m/s, in two directions."""
    at = 28  # headers, envelope and encapsulation
    return [
        replace(item, payload=item.payload[:at] + struct.pack("<2d", 9.0, 9.0) + item.payload[at + 16 :])
        if msg_id(item) == 0x1827
        else item
        for item in items
    ]


def test_other_values_are_worse_and_the_first_message_is_named(compare, tmp_path):
    items = datagrams(ROVER)[:200]
    good, bad = write(tmp_path / "good.pcap", items), write(tmp_path / "bad.pcap", ninefold(items))
    done = compare(good, bad, "-c", MISSION, "--tolerance", "linear.y=9", "--json")
    told = json.loads(done.stdout)
    held(told, ["compare", "--json"])
    (change,) = (item for item in told["changes"] if item["what"] == "value")
    first = next(number for number, item in enumerate(items, 1) if msg_id(item) == 0x1827)
    assert (change["what"], change["route"], change["field"]) == ("value", "/cmd_vel", "linear.x")
    assert (change["bad"], change["first"][0], done.exit_code) == (9.0, first, 3)


def test_many_runs_of_a_folder(compare, tmp_path):
    """Two runs beside two that lack every third telemetry message: by the interval of the mean."""
    items = datagrams(ROVER)
    for number, name in enumerate(("good", "bad")):
        (tmp_path / name).mkdir()
        for place in range(2):
            own = items[: 1000 - 40 * place]
            own = without(0x827, 3)(own) if number else own
            write(tmp_path / name / f"{place}.pcap", own)
    junit = tmp_path / "r.xml"
    output = ("--json", "--junit", junit)
    done = compare(tmp_path / "good", "--against", tmp_path / "bad", "-c", MISSION, *output)
    told = json.loads(done.stdout)
    console = Console(width=80, record=True, file=StringIO())
    console.print(runs_view(told, 80))
    assert "Difference (95 %)" in console.export_text()
    held(told, ["compare", "--json"])
    assert (done.exit_code, told["good"]["runs"], told["bad"]["runs"]) == (3, 2, 2)
    (lost,) = (item for item in told["points"] if item["what"] == "lost" and item["msg_id"] == "0x0827")
    assert lost["worse"]
    assert lost["interval"][0] > 0
    assert 0.2 < lost["bad"] - lost["good"] < 0.35
    cases = parse(junit).getroot().findall("testsuite/testcase")
    assert len(cases) == len(told["points"])
    assert sum(case.find("failure") is not None for case in cases) == sum(
        item["worse"] for item in told["points"]
    )


def test_limits_of_routes(compare):
    words = ("--max-loss", "15%", "--max-loss", "/telemetry_pose=1%", "--max-delay", "/cmd_vel=400ms")
    done = compare(ROVER, ROVER, "-c", MISSION, "--json", *words)
    worse = {(item["what"], item["route"]) for item in json.loads(done.stdout)["changes"] if item["worse"]}
    assert (worse, done.exit_code) == ({("max_loss", "/cmd_vel"), ("max_delay", "/cmd_vel")}, 3)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((ROVER,), "two runs are compared"),
        ((ROVER, ROVER, "--tolerance", "much"), "neither a percentage nor FIELD=VALUE"),
        ((MISSION.parent, "--against", ROVER), "no capture in it"),
    ],
)
def test_what_cannot_be_compared(words, text, compare):
    done = compare(*words)
    assert done.exit_code != 0
    assert text in str(done.exception) + done.output
