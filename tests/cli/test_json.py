"""What ``--json`` prints, on which other people's scripts rely; and exit code 3."""

import json
import re

import pytest
from schema import check, published

from edoras_tools.io import SourceDefaults
from edoras_tools.io.capture import live
from edoras_tools.io.formats.open import open_file
from edoras_tools.model import Finding, SourceInfo, SourceStatistics

LABELS = {bit.label for bit in Finding}


def check_report(report):
    for row in report["routes"]:
        assert row["link"] in {"ci", "to", "sbn", "robot", "other"}
        assert row["msg_id"] is None or re.fullmatch("0x[0-9a-f]{4}", row["msg_id"])
        assert set(row["findings"]) <= LABELS
        assert sum(row["findings"].values()) == 0 or max(row["findings"].values()) <= row["count"]
    for label, count in report["findings"].items():
        assert count == sum(row["findings"].get(label, 0) for row in report["routes"])


@pytest.mark.parametrize("name", ["a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect"])
def test_info(name, call, captures, missions):
    done = call("info", "--json", captures(name), *missions("rover_ground"))
    assert done.code == 0
    report = done.json()
    check_report(report)
    assert (report["source"], report["kind"]) == (str(captures(name)), "pcap")


def test_info_of_the_rover(call, captures, missions):
    report = call("info", "--json", captures("a_rover"), *missions("rover_ground")).json()
    routes = {row["topic"]: row for row in report["routes"]}
    drive, pose = routes["/cmd_vel"], routes["/telemetry_pose"]
    assert (drive["count"], drive["msg_id"], drive["link"], drive["bytes_max"]) == (600, "0x1827", "ci", 76)
    assert (pose["count"], pose["msg_id"], pose["link"], pose["bytes_max"]) == (63, "0x0827", "to", 116)
    assert (drive["rate_hz"], pose["rate_hz"]) == (pytest.approx(10, rel=0.01), pytest.approx(1, rel=0.01))
    assert [row["topic"] for row in report["routes"][:2]] == ["/cmd_vel", "/telemetry_pose"]
    assert list(report["findings"]) == sorted(report["findings"])


def test_info_of_several(call, captures):
    done = call("info", "--json", captures("a_rover"), captures("e_ci_errors"))
    assert done.json()["datagrams"] == 1827 + 1377


def test_record_reports_as_info_does_and_names_its_output(call, captures, missions, tmp_path):
    options = [captures("a_rover"), *missions("rover_ground")]
    said = call("info", "--json", *options).json()
    done = call("record", "--json", "-r", *options, "-o", tmp_path / "x.mcap")
    report = done.json()
    check_report(report)
    assert report.pop("outputs") == [str(tmp_path / "x.mcap")]
    assert {name: report[name] for name in said} == said
    assert done.err == []


@pytest.mark.quick("e_ci_errors")
@pytest.mark.parametrize("name", ["a_rover", "e_ci_errors", "f_sbn_disconnect"])
def test_sniff_and_decode(name, call, captures, missions):
    lines = call("sniff", "-a", "--json", "-r", captures(name), *missions("rover_ground")).lines()
    for packet in lines:
        assert packet["msg_id"] is None or re.fullmatch("0x[0-9a-f]{4}", packet["msg_id"])
        assert set(packet["findings"]) <= LABELS
    chosen = lines[len(lines) // 2]
    one = call("decode", "--json", captures(name), chosen["number"], *missions("rover_ground")).json()
    assert one == chosen


def test_recover(call, captures, tmp_path):
    call("record", "-q", "-r", captures("a_rover"), "-o", tmp_path / "x.mcap")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((tmp_path / "x.mcap").read_bytes()[:-40])
    report = call("recover", "--json", cut, "-o", tmp_path / "y.mcap").json()
    names = ["whole", "messages", "chunks", "salvaged", "kept_bytes", "lost_bytes"]
    names += ["proved", "unproved", "left_out", "lost", "lost_messages", "losses", "reasons", "unit"]
    assert list(report) == ["schema", *names, "output"]
    assert call("info", "--verify", "--json", cut).json() == {
        "schema": 1,
        "source": str(cut),
        **{name: report[name] for name in names},
    }
    assert (report["whole"], report["output"]) == (False, str(tmp_path / "y.mcap"))
    assert report["messages"]["/edoras/datagrams"] == 1827
    whole = call("recover", "--json", tmp_path / "y.mcap", "-o", tmp_path / "z.mcap").json()
    assert (whole["whole"], whole["output"], whole["messages"]) == (True, None, report["messages"])
    assert not (tmp_path / "z.mcap").exists()


class Lossy(SourceDefaults):
    """A live source whose kernel lost packets."""

    live = True

    def __init__(self, batches):
        self.info = SourceInfo("lo", "live")
        self.statistics = SourceStatistics()
        self._batches = batches

    def batches(self):
        for batch in self._batches:
            self.statistics.datagrams += len(batch)
            yield batch
        self.statistics.kernel_drops = 42

    def stop(self):
        pass

    def close(self):
        pass


@pytest.mark.parametrize(
    "command", ["sniff -i lo", "record -q -i lo -o x.mcap", "record --json -i lo -o x.pcap"]
)
def test_losses_are_told_and_are_exit_code_3(command, call, captures, monkeypatch, tmp_path):
    source = open_file(captures("a_rover"))
    batches = list(source.batches())
    source.close()
    monkeypatch.setattr(live, "open_live", lambda *_, **__: Lossy(batches))
    monkeypatch.chdir(tmp_path)
    done = call(*command.split())
    assert done.code == 3
    assert done.err == ["edoras: the capture itself lost 42 packets; it was too slow for them"]
    if "--json" in command:
        assert json.loads(done.out)["capture_drops"] == 42


@pytest.mark.parametrize(
    ("arguments", "code", "error"),
    [
        (
            ["info", "none.pcap", "--json"],
            1,
            {"code": "capture", "message": "none.pcap: there is no such file", "hint": "check the name"},
        ),
        (["info", "--json"], 2, {"code": "config", "hint": "FILE"}),
        (["info", "--json", "--nope"], 2, {"code": "usage", "hint": "see edoras info -h"}),
    ],
)
def test_an_error_is_json_too(arguments, code, error, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = call(*arguments)
    assert (done.code, done.out, len(done.err)) == (code, "", 1)
    told = json.loads(done.err[0])
    check(told, published("error"))
    if "message" in error:
        assert told["error"] == error
    assert told["error"]["code"] == error["code"]


def test_many_mistakes_are_one_error(call, tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(
        "b:\n  ros__parameters:\n    communication: {nope: 1}\n    command: [a]\n    telemetry: [b]\n"
    )
    done = call("info", "x.pcap", "-c", path, "--json")
    assert len(done.err) == 1
    told = json.loads(done.err[0])["error"]
    assert told["message"]
