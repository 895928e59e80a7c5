"""``--where``, ``--fields``, ``--sequence`` and ``--stat`` as a shell sees them."""

import csv
import io

import pytest

POSES = "msg_id == 0x827 and pose.position.x > 1"


def test_sniff(call, captures, missions):
    told = call("sniff", "-r", captures("a_rover"), *missions("rover_ground"), "--json", "--where", POSES)
    assert told.code == 0
    every = call("sniff", "-r", captures("a_rover"), *missions("rover_ground"), "--json").lines()
    wanted = [
        item
        for item in every
        if item["msg_id"] == "0x0827" and item["message"] and item["message"]["pose"]["position"]["x"] > 1
    ]
    assert told.lines() == wanted
    assert 0 < len(wanted) < 63


def test_record_and_info(call, captures, missions, tmp_path):
    out = tmp_path / "poses.mcap"
    told = call(
        "record", "-r", captures("a_rover"), *missions("rover_ground"), "--where", POSES, "-o", out, "--json"
    ).json()
    assert told["datagrams"] == 53
    assert call("info", out, "--json").json()["datagrams"] == 53
    assert call("info", out, "--json", "--where", "pose.position.x > 6").json()["datagrams"] == 3
    assert call("info", captures("a_rover"), "--json", "--link", "ci").json()["datagrams"] == 601


def test_with_other_choices(call, captures, missions):
    source = ("-r", captures("a_rover"), *missions("rover_ground"))
    told = call(
        "sniff", *source, "--fields", "number", "--format", "csv", "--link", "to", "--where", "length > 200"
    )
    assert len(told.out.splitlines()) - 1 == 63


@pytest.mark.parametrize("command", ["sniff", "record", "info"])
def test_mistakes_end_with_usage(call, captures, command, tmp_path):
    source = [captures("a_rover")] if command == "info" else ["-r", captures("a_rover")]
    out = ["-o", tmp_path / "never.mcap"] if command == "record" else []
    for text, why, mark in (
        ("msg_id = 1", "character 8: equality is written ==", "         ^"),
        ("msg_ld == 1", "character 1: 'msg_ld' is not a field; did you mean msg_id", "  ^^^^^^"),
        ("link < 'x'", "character 8: link has no 'x'", "         ^^^"),
    ):
        told = call(command, *source, *out, "--where", text)
        assert told.code == 2
        first, second, third = told.err[-3:]
        assert why in first
        assert second == f"edoras:   {text}"
        assert third == f"edoras: {mark}"
        assert not told.out
    assert not list(tmp_path.iterdir())


def test_a_filter_that_lets_nothing_pass_says_so(call, captures):
    told = call("info", captures("a_rover"), "--where", "msg_id == 1")
    assert told.code == 0
    assert told.err[-1] == "edoras: none of the 1,827 datagrams was selected"


FIELDS = "number,time,link,msg_id,sbn.msg_type,cfe_event.message,pose.position.x"


def test_fields_as_csv(call, captures, missions):
    source = ("-r", captures("a_rover"), "-n", 500, *missions("rover_ground"))
    told = call("sniff", *source, "--fields", FIELDS, "--format", "csv")
    rows = list(csv.DictReader(io.StringIO(told.out)))
    every = call("sniff", *source, "--json").lines()
    assert len(rows) == len(every)
    start = every[0]["time_ns"]
    for row, item in zip(rows, every, strict=True):
        assert row["number"] == str(item["number"])
        assert row["time"] == f"{(item['time_ns'] - start) / 1e9:.6f}"
        assert row["link"] == item["link"]
        assert row["msg_id"] == (item["msg_id"] or "")
        assert row["cfe_event.message"] == item["layers"].get("cfe_event", {}).get("message", "")


def test_fields_as_tsv_and_table(call, captures):
    source = ("-r", captures("a_rover"), "--link", "to", "-n", "2")
    tsv = call("sniff", *source, "--fields", "number,msg_id,length", "--format", "tsv").out
    assert tsv.splitlines()[0] == "number\tmsg_id\tlength"
    assert len(tsv.splitlines()) == 3
    table = call("sniff", *source, "--fields", "number,msg_id,length").out
    assert [line.split() for line in table.splitlines()] == [line.split("\t") for line in tsv.splitlines()]
    assert len({len(line) for line in table.splitlines()}) == 1


def test_sequence(call, captures):
    for kind, first in (("mermaid", "sequenceDiagram"), ("plantuml", "@startuml")):
        told = call("sniff", "-r", captures("f_sbn_disconnect"), "--sequence", kind)
        assert told.code == 0
        assert told.out.splitlines()[0] == first
        assert "DISCONNECT, 61.981 s" in told.out


def test_statistics(call, captures):
    told = call("sniff", "-r", captures("f_sbn_disconnect"), "--stat", "sbn", "--stat", "findings")
    assert told.code == 0
    assert "DISCONNECT" in told.out
    assert "sbn_version_mismatch" in told.out
    every = ["routes", "sbn", "sizes", "findings"]
    asked = [word for kind in every for word in ("--stat", kind)]
    found = call("sniff", "-r", captures("f_sbn_disconnect"), *asked, "--json").json()
    assert list(found) == ["schema", *every]
    assert found["findings"]["sbn_version_mismatch"] == 1


def test_one_view_at_a_time(call, captures):
    told = call("sniff", "-r", captures("a_rover"), "--fields", "number", "-x")
    assert told.code == 2
    assert told.err == ["edoras: --fields and -x exclude each other; choose one"]
