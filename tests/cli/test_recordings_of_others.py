"""Recordings of other tools on every command that reads: with ``-r``, several, piped, packed, in part."""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
import threading

import pytest
import zstandard
from mcap.writer import Writer
from others import BEGIN, read_bag, write_bag, write_studio
from rosbags.rosbag2 import StoragePlugin

CHECKED = """schema: 1
topics:
  /cmd_vel: {count: at least 1, size: 52}
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "e.yaml").write_text(CHECKED)
    return tmp_path


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("bag") / "bag")


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    return write_bag(tmp_path_factory.mktemp("database") / "bag", StoragePlugin.SQLITE3)


def counted(call, command, *inputs):
    """Return how many messages a command read."""
    if command == "info":
        return call("info", "--json", *inputs).json()["messages"]
    if command == "sniff":
        return len(call("sniff", "--json", *inputs).lines())
    if command == "record":
        return call("record", "--json", *inputs, "-o", "x.mcap", "--force").json()["messages"]
    if command == "check":
        results = call("check", "--json", *inputs, "e.yaml").json()["results"]
        return int(results[0]["found"].partition(" ")[0])
    assert command == "export"
    files = call("export", "--json", *inputs, "-o", "x/", "--force").json()["files"]
    return sum(item["rows"] for item in files)


COMMANDS = {"info": 205, "sniff": 205, "record": 205, "check": 100, "export": 205}


@pytest.mark.quick("record*")
@pytest.mark.parametrize(("command", "count"), COMMANDS.items())
def test_bare_with_the_option_and_several(command, count, bag, database, folder, call):
    other = write_studio(folder / "other.mcap")
    assert counted(call, command, database) == count
    assert counted(call, command, bag) == counted(call, command, "-r", bag) == count
    both = {"check": 120, "export": 205 + 40}.get(command, 205 + 100)
    assert counted(call, command, bag, other) == counted(call, command, "-r", bag, "-r", other) == both


def storage(bag):
    (file,) = [item for item in bag.iterdir() if item.suffix != ".yaml"]
    return file


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("command", "packing"),
    [("info", "gz"), ("sniff", "zst"), ("record", "zstd"), ("check", "gz"), ("export", "zst")],
)
def test_packed(command, packing, bag, database, folder, call):
    for file in (storage(bag), storage(database)):
        data = file.read_bytes()
        path = folder / f"{file.name}.{packing}"
        path.write_bytes(
            gzip.compress(data) if packing == "gz" else zstandard.ZstdCompressor().compress(data)
        )
        assert counted(call, command, path) == COMMANDS[command]


PIPED = {
    "info": [],
    "sniff": [],
    "check": ["e.yaml"],
    "record": ["-q", "-o", "x.mcap", "--force"],
    "export": ["-q", "-o", "x/", "--force"],
    "plot": ["--bare", "rate:*"],
    "decode": ["5"],
}


@pytest.mark.quick("export*")
@pytest.mark.parametrize(("command", "words"), PIPED.items())
def test_through_a_pipe(command, words, bag, database, call, monkeypatch):
    for file in (storage(bag), storage(database)):
        plain = call(command, file, *words)
        reading, writing = os.pipe()
        feeder = threading.Thread(target=fed, args=(writing, file.read_bytes()))
        feeder.start()
        with os.fdopen(reading, "rb") as piped:
            monkeypatch.setattr("sys.stdin", piped)
            done = call(command, "-", *words)
        feeder.join()
        assert (done.code, plain.code) == (0, 0), done.err
        # Their names differ, and with them the widths of lines that hold them.
        assert done.out.split() == plain.out.replace(str(file), "-").replace(file.name, "-").split()


def fed(end, data):
    with os.fdopen(end, "wb") as pipe:
        pipe.write(data)


@pytest.mark.parametrize("command", ["info", "sniff"])
def test_standard_input_that_is_a_file(command, bag, database, call, monkeypatch):
    for file in (storage(bag), storage(database)):
        with file.open("rb") as given:
            monkeypatch.setattr("sys.stdin", given)
            assert counted(call, command, "-") == 205


@pytest.mark.quick("part3*")
@pytest.mark.parametrize(
    ("part", "seconds"),
    [
        (["--start", "0.5", "--end", "1s"], (0.5, 1.0)),
        (["--start", "500ms"], (0.5, 9)),
        (["--end", "1000ms"], (0, 1.0)),
        (["--start", "14:13:21", "--tz", "UTC"], (1.0, 9)),
        (["--start", "16:13:21", "--end", "16:13:21.5", "--tz", "Europe/Berlin"], (1.0, 1.5)),
        (["--start", "2026-09-21T14:13:21Z"], (1.0, 9)),
        (["--start", "0", "--end", "5min"], (0, 300)),
    ],
)
def test_the_same_part_on_every_command(part, seconds, database, call):
    first, last = (int(item * 10**9) for item in seconds)
    said = [item for item in read_bag(database) if first <= item[0] - BEGIN < last]
    for command in COMMANDS:
        if command != "check":
            assert counted(call, command, database, *part) == len(said), command
    twists = [item for item in said if item[1] == "/cmd_vel"]
    assert counted(call, "check", database, *part) == len(twists)


@pytest.mark.each(2)
@pytest.mark.parametrize(("where", "count"), [("linear.x >= 5", 50), ("topic == /cmd_vel", 100)])
def test_the_same_filter_on_every_command(where, count, bag, call):
    for command in COMMANDS:
        assert counted(call, command, bag, "--where", where) == count, command
        assert counted(call, command, bag, "--where", where, "--topic", "cmd_vel") == count, command


@pytest.mark.each(3)
@pytest.mark.parametrize("option", [["--link", "ci"], ["--msg-id", "0x827"], ["--where", "link == ci"]])
@pytest.mark.parametrize("command", [*COMMANDS, "plot"])
def test_what_needs_datagrams_is_refused_in_one_line(command, option, bag, call):
    words = {"check": ["e.yaml"], "record": ["-o", "x.mcap"], "export": ["-o", "x/"]}.get(command, [])
    done = call(command, bag, *option, *words)
    assert done.code == 2
    assert "the recording has only messages" in done.err[0]


@pytest.mark.parametrize(
    "words",
    [["--sequence", "mermaid"], ["--stat", "sbn"], ["-a"]],
)
def test_views_that_need_datagrams_are_refused(words, bag, call):
    done = call("sniff", bag, *words)
    assert (done.code, done.out, len(done.err)) == (2, "", 1)
    assert "has messages and no datagrams" in done.err[0]


@pytest.mark.parametrize("words", [["-o", "x.pcap"], ["-o", "x.pcapng"], ["-o", "x.mcap", "--tf"]])
def test_what_cannot_be_recorded(words, bag, folder, call):
    done = call("record", bag, *words)
    assert (done.code, len(done.err)) == (2, 1)
    assert "has messages and no datagrams" in done.err[0]
    assert not [*folder.glob("x.*")]


def test_with_a_capture_they_are_read_separately(bag, captures, call):
    for words in (["sniff"], ["info"], ["record", "-o", "x.mcap"], ["export", "-o", "x/"]):
        done = call(*words, bag, captures("a_rover"))
        assert (done.code, done.out) == (2, "")
        assert "read them separately" in done.err[0]


def test_fields_are_printed(bag, call):
    text = call("sniff", bag, "--fields", "time,topic,linear.x,name", "--format", "csv").out
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == 205
    assert [row["linear.x"] for row in rows if row["topic"] == "/cmd_vel"] == [
        str(n / 10) for n in range(100)
    ]
    assert [row["name"] for row in rows if row["topic"] == "/custom"] == [f"n{n}" for n in range(0, 100, 2)]


def test_the_tree_and_the_bytes(bag, call):
    tree = call("sniff", bag, "-V", "--topic", "custom", "-n", "1").out
    assert all(word in tree for word in ("Message 3", "/custom  my_msgs/msg/Custom", "quad", '"n0"'))
    assert "UDP" not in tree
    assert "Message, 52 bytes" in call("sniff", bag, "-x", "--topic", "cmd_vel", "-n", "1").out
    decoded = call("decode", bag, "3", "--json").json()
    assert (decoded["topic"], decoded["message"]["name"]) == ("/custom", "n0")


def test_every_encoding_is_listed_with_its_count(folder, call):
    path = write_studio(folder / "x.mcap")
    found = call("info", path, "--json").json()
    assert {row["topic"]: row["count"] for row in found["routes"]} == dict.fromkeys(
        ("/status", "/proto", "/cmd_vel", "/outer", "/raw"), 20
    )
    told = call("info", path).err
    assert [line.partition(": ")[2] for line in told] == found["warnings"]
    assert found["warnings"] == [
        "/status: 20 messages: json, not cdr: shown and copied, without fields to select, plot or export",
        "/proto: 20 messages: protobuf, not cdr: only counted and copied",
        "/raw: 20 messages: without a schema: only counted and copied",
    ]
    values = [item["message"] for item in call("sniff", "--json", path, "--topic", "status").lines()]
    assert values == [{"ok": n % 2 == 0, "n": n, "who": {"list": [1, 2]}} for n in range(20)]
    table = call("export", path, "--topic", "outer", "-o", "-", "--format", "jsonl").out
    rows = [json.loads(line) for line in table.splitlines()]
    assert [row["inner.n"] for row in rows] == list(range(20))


@pytest.mark.parametrize(
    "words",
    [
        ["sniff", "--where", "n > 1"],
        ["sniff", "--fields", "n"],
        ["export", "-o", "x.csv"],
        ["export", "-o", "x/"],
        ["export", "-o", "x.csv", "--topic", "/status"],
        ["plot", "/status.n"],
    ],
)
def test_that_topics_in_json_have_no_fields_is_said_by_whatever_asks_for_one(words, folder, call):
    with (folder / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Status", "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/status", "json", schema)
        writer.add_message(channel, 1, b'{"n": 1}', 1)
        writer.finish()
    done = call(words[0], "x.mcap", *words[1:])
    assert done.code in {1, 2}
    assert "json, not cdr: shown and copied, without fields to select, plot or export" in done.err[0]
    assert "/status" in done.err[0]
    assert "-c" not in done.err[0]


def test_a_recording_without_a_message(folder, call):
    write_bag(folder / "empty", count=0)
    for words in (["info"], ["sniff"], ["record", "-o", "x.mcap"]):
        done = call(*words, "empty")
        assert done.code == 1
        assert "empty: no message in it" in done.err[-1]


def test_nothing_chosen_is_told(bag, call):
    done = call("sniff", bag, "--where", "linear.x > 1000")
    assert (done.code, done.out) == (0, "")
    assert done.err == ["edoras: none of the 205 messages was selected"]


def test_what_a_recording_holds_moves_no_terminal(folder, call):
    """Names and texts with control characters, in topics that are read and in those that are not."""
    with (folder / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("", "")
        for encoding, kind, text, data in (
            ("cdr", "my\x1b[31m/msg/Red", b"int32 a\n", bytes(8)),
            ("cdr", "std_msgs/msg/String", b"string data\n", b"\0\1\0\0\6\0\0\0\x1b[31m\0"),
            ("json", "J\x1b[1m", b"{}", b'{"k\\u001b[31m": "\\u001b[31m"}'),
        ):
            schema = writer.register_schema(kind, "ros2msg", text)
            channel = writer.register_channel(f"/{encoding}{len(text)}\x1b[31m\nline", encoding, schema)
            writer.add_message(channel, 0, data, 0)
        writer.finish()
    for words in (
        ["info"], ["sniff"], ["sniff", "-V"], ["sniff", "-x"], ["sniff", "--json"],
        ["sniff", "--stat", "routes"],
        ["sniff", "--topic", "nope"], ["record", "-o", "y.mcap"], ["check", "--init"], ["export", "-o", "y/"],
        ["plot"], ["decode", "3"],
    ):  # fmt: skip
        done = call(words[0], "x.mcap", *words[1:])
        shown = "\n".join((done.out, *done.err))
        assert "\x1b" not in shown, words
        assert not any(line.startswith("line") for line in shown.splitlines()), words
