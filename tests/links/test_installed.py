"""The package of ``samples/links``, installed as any is: a link, a format, a command; no file knows it."""

from __future__ import annotations

import csv
import importlib
import json
import os
import shutil
import struct
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import warm
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from places import SAMPLES
from toml_files import TOML
from waiting import HOST, Ear, Program, free_ports, until

from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.errors import CaptureError, ConfigError, WireError
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.wire import cfe

EDORAS = Path(sys.executable).with_name("edoras")
MAGIC = b"\xed\x0a"
PORT = 5600
PANES = """
import asyncio, sys
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.addons.tui.viewer import Viewer, ViewOptions

async def main():
    settings = Settings()
    app = Viewer(open_files([sys.argv[1]]), settings.workbench(), ViewOptions(Selection(), settings))
    async with app.run_test(size=(120, 40)) as pilot:
        while app.reading or app.decoded is None:
            await pilot.pause(0.01)
        for pane in (app.packets, app.layers, app.hex_pane):
            print("PANE", *(pane.render_line(line).text.rstrip() for line in range(pane.page)), sep="\\n")

asyncio.run(main())
"""


def udp(payload: bytes, port: int = PORT) -> bytes:
    """An IPv4 packet without a link layer."""
    ends = bytes((127, 0, 0, 1)) * 2
    head = struct.pack(">BBHHHBBH", 0x45, 0, 28 + len(payload), 1, 0, 64, 17, 0) + ends
    return head + struct.pack(">HHHH", 40000, port, 8 + len(payload), 0) + payload


def write(path: Path, payloads: list[bytes]) -> Path:
    records = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 101)]
    for number, payload in enumerate(payloads):
        frame = udp(payload)
        records.append(struct.pack("<IIII", 1_795_000_000 + number, 0, len(frame), len(frame)) + frame)
    path.write_bytes(b"".join(records))
    return path


def header(station: int, count: int) -> bytes:
    return MAGIC + struct.pack(">BbH", station, -90, count)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder with the package installed, as pip would lay it out."""
    folder = tmp_path_factory.mktemp("site")
    settings = TOML.loads((SAMPLES / "links/pyproject.toml").read_text())
    project = settings["project"]
    for name in settings["tool"]["setuptools"]["py-modules"]:
        shutil.copy(SAMPLES / f"links/{name}.py", folder)
    info = folder / f"edoras_radio_link-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    groups = (
        [f"[{group}]", *(f"{name} = {value}" for name, value in entries.items())]
        for group, entries in project["entry-points"].items()
    )
    (info / "entry_points.txt").write_text("\n".join(line for group in groups for line in group) + "\n")
    return folder


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Three packets over the radio, and one datagram to its port that is none of it."""
    packets = [cfe.emit_telemetry(0x0800), cfe.emit_telemetry(0x0800), cfe.emit_command(0x1880, 6, bytes(16))]
    payloads = [header(7 if number else 9, number) + packet for number, packet in enumerate(packets)]
    return write(tmp_path_factory.mktemp("radio") / "radio.pcap", [*payloads, b"GET / HTTP/1.1\r\n"])


@pytest.fixture
def edoras(site):
    """A function: run ``edoras`` where the package is installed, from a server that knows it; its output."""

    def run(*command):
        done = warm.run(*command, packages=site, text=True)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


@pytest.fixture
def started(site):
    """A function: the same for a program that is started as users do; its output."""

    def run(*command):
        done = subprocess.run(
            [*map(str, command)],
            env={**os.environ, "PYTHONPATH": str(site)},
            capture_output=True,
            text=True,
            check=False,
            timeout=120,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_it_is_sniffed_and_filtered(edoras, capture):
    def numbers(*choice):
        return [
            json.loads(line)["number"]
            for line in edoras("sniff", "-r", capture, "--json", *choice).splitlines()
        ]

    assert numbers() == [1, 2, 3]
    assert numbers("--link", "radio") == [1, 2, 3]
    assert numbers("--link", "other") == [4]
    assert numbers("--where", "link == radio and radio.station == 7") == [2, 3]
    assert numbers("--where", "radio.signal_dbm < -80 and cfe_command.function_code == 6") == [3]


@pytest.mark.long
def test_it_is_recorded_and_read_back(edoras, capture, tmp_path):
    edoras("record", "-r", capture, "-o", tmp_path / "radio.mcap", "-q")
    edoras("record", "-r", tmp_path / "radio.mcap", "-o", tmp_path / "again.pcap", "-q")
    assert (tmp_path / "again.pcap").read_bytes() == capture.read_bytes()
    back = edoras("sniff", "-r", tmp_path / "radio.mcap", "--json", "--link", "radio")
    assert back == edoras("sniff", "-r", capture, "--json", "--link", "radio")


def test_its_command_counts_who_heard_the_modem(edoras, started, capture):
    assert started(EDORAS, "radio", capture) == (
        "station 7  2 datagrams  -90 to -90 dBm  0 lost\nstation 9  1 datagrams  -90 to -90 dBm  0 lost\n"
    )
    listed = " ".join(edoras("--help").split())
    assert "Show which ground stations heard the modem, and how well." in listed
    assert "FILE" in edoras("help", "radio")


def logged(payload, time_ns, source=40000, destination=PORT):
    return struct.pack(">qHHHH", time_ns, source, destination, len(payload), 0) + payload


def test_its_format_is_written_and_read(edoras, capture, tmp_path):
    log = tmp_path / "radio.radiolog"
    edoras("record", "-r", capture, "-o", log, "-q")
    (batch,) = open_file(capture).batches()
    payloads = [batch[row].payload for row in range(len(batch))]
    assert log.read_bytes() == b"RADIOLOG" + b"".join(
        logged(payload, (1_795_000_000 + number) * 10**9) for number, payload in enumerate(payloads)
    )
    assert json.loads(edoras("info", log, "--json"))["kind"] == "radio log"
    assert edoras("radio", log) == edoras("radio", capture)
    there, here = (
        [
            {key: item[key] for key in ("number", "time_ns", "link", "length")}
            for item in map(json.loads, edoras("sniff", "-r", path, "--json").splitlines())
        ]
        for path in (log, capture)
    )
    assert there == here
    edoras("record", "-r", log, "-o", tmp_path / "again.mcap", "-q")
    edoras("record", "-r", tmp_path / "again.mcap", "-o", tmp_path / "again.radiolog", "-q")
    assert (tmp_path / "again.radiolog").read_bytes() == log.read_bytes()


def test_without_the_package_its_file_is_no_capture(tmp_path):
    path = tmp_path / "radio.radiolog"
    path.write_bytes(b"RADIOLOG" + logged(b"x", 1))
    with pytest.raises(CaptureError, match=r"looks like text; pcap, pcapng and MCAP can be read"):
        open_file(path)


@given(
    st.lists(st.tuples(st.integers(0, 2**62), st.integers(0, 65535), st.binary(max_size=90)), max_size=9),
    st.integers(0, 200),
)
def test_a_log_cut_anywhere_is_read_as_far_as_it_goes(installed, tmp_path_factory, entries, cut):
    path = tmp_path_factory.mktemp("log") / "cut.radiolog"
    whole = [logged(payload, time_ns, destination=port) for time_ns, port, payload in entries]
    data = (b"RADIOLOG" + b"".join(whole))[: max(8, 8 + sum(map(len, whole)) - cut)]
    path.write_bytes(data)
    complete, room = 0, len(data) - 8
    while complete < len(whole) and room >= len(whole[complete]):
        room -= len(whole[complete])
        complete += 1
    source, found = open_file(path), []
    with pytest.raises(CaptureError, match="ends inside record") if room else nullcontext():
        for batch in source.batches():
            found += [(item.time_ns, item.payload) for item in (batch[row] for row in range(len(batch)))]
    assert found == [(time_ns, payload) for time_ns, _, payload in entries[:complete]]


@pytest.fixture(scope="module")
def losses(tmp_path_factory):
    """Station 3 heard 8 of 10 frames, station 4 three, of a modem that was started in between."""
    packet = cfe.emit_telemetry(0x0800, bytes(8))
    three = [MAGIC + struct.pack(">BbH", 3, -80 - count, count) for count in range(10) if count not in {4, 5}]
    four = [MAGIC + struct.pack(">BbH", 4, -60, count) for count in (65535, 0, 40000)]
    return write(tmp_path_factory.mktemp("lost") / "lost.pcap", [head + packet for head in three + four])


def test_its_signals_are_messages_that_are_recorded_and_exported(edoras, losses, tmp_path):
    edoras("record", "-r", losses, "-o", tmp_path / "run.mcap", "-q")
    found: dict[str, list[bytes]] = {}
    with (tmp_path / "run.mcap").open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.topic.startswith("/radio/"):
                assert (schema.name, channel.message_encoding) == ("std_msgs/msg/Int8", "cdr")
                found.setdefault(channel.topic, []).append(message.data)
    strengths = [-80 - count for count in range(10) if count not in {4, 5}]
    assert found == {
        "/radio/station_3/signal_dbm": [b"\0\1\0\0" + struct.pack("b", item) for item in strengths],
        "/radio/station_4/signal_dbm": [b"\0\1\0\0" + struct.pack("b", -60)] * 3,
    }
    edoras("export", tmp_path / "run.mcap", "-o", tmp_path / "csv", "--format", "csv", "-q")
    (table_,) = (tmp_path / "csv").rglob("*station_3*.csv")
    rows = list(csv.DictReader(table_.read_text().splitlines()))
    assert [int(row["data"]) for row in rows] == strengths


def test_the_doctor_says_what_its_counts_show(losses, site):
    done = warm.run("doctor", losses, "--json", packages=site, text=True)
    (verdict,) = [item for item in json.loads(done.stdout)["verdicts"] if item["rule"] == "radio_frames_lost"]
    assert (done.returncode, verdict["severity"], verdict["hop"]) == (3, "error", "radio")
    assert verdict["reason"] == "station 3 did not hear 2 of 10 frames"
    assert verdict["evidence"] == ["frame counts; signal -89 to -80 dBm"]


def test_it_is_replayed_with_counts_of_its_own_and_relayed(site, edoras, losses, tmp_path):
    near = free_ports(1)[0]
    with Ear() as ear:
        words = ("--listen", f"{HOST}:{near}", "--target", f"{HOST}:{ear.port}", "-o", tmp_path / "x.mcap")
        environ = {**os.environ, "PYTHONPATH": str(site)}
        with Program(EDORAS, "proxy", "radio", *words, "--json", env=environ) as proxy:
            assert proxy.line(proxy.err).startswith("relaying radio")
            edoras("replay", losses, "--to", "radio", "--target", f"{HOST}:{near}", "--speed", "max", "-q")
            got: list[bytes] = []
            until(lambda: got.extend(ear.take()) or len(got) >= 11)
            proxy.end()
    assert [struct.unpack(">BbH", item[2:6])[::2] for item in got] == [
        *((3, count) for count in range(8)),
        *((4, count) for count in range(3)),
    ]
    back = edoras("sniff", "-r", tmp_path / "x.mcap", "--json", "--link", "radio").splitlines()
    assert len(back) == 11


@pytest.mark.long
def test_it_is_counted(edoras, capture):
    routes = json.loads(edoras("info", capture, "--json"))["routes"]
    assert [(row["link"], row["msg_id"], row["count"]) for row in routes] == [
        ("radio", "0x0800", 2),
        ("radio", "0x1880", 1),
        ("other", None, 1),
    ]
    assert "RADIO" in edoras("sniff", "-r", capture, "--stat", "routes")


@pytest.mark.long
def test_it_is_shown_in_the_three_panes(started, capture):
    shown = started(sys.executable, "-c", PANES, capture)
    packets, layers, octets = shown.split("PANE\n")[1:]
    assert "RADIO" in packets
    assert "Radio modem" in layers
    assert "ed 0a" in octets


def test_tshark_shows_it(edoras, capture, tmp_path):
    if shutil.which("tshark") is None:
        pytest.skip("needs tshark: make judges")
    script = tmp_path / "edoras.lua"
    script.write_text(edoras("wireshark", "print"))
    fields = [
        part for name in ("radio.station", "radio.signal_dbm", "edoras.msg_id") for part in ("-e", name)
    ]
    done = subprocess.run(
        ["tshark", "-X", f"lua_script:{script}", "-r", capture, "-Y", "radio", "-T", "fields", *fields],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    assert [line.split() for line in done.stdout.splitlines()] == [
        ["9", "-90", "0x0800"],
        ["7", "-90", "0x0800"],
        ["7", "-90", "0x1880"],
    ]


@pytest.fixture(scope="module")
def installed(site):
    """The link in this process; afterwards the table is as it was."""
    caches = (table.links, table._by_code)
    sys.path.insert(0, str(site))
    importlib.invalidate_caches()
    for cached in caches:
        cached.cache_clear()
    yield table.link_of_label("radio")
    sys.path.remove(str(site))
    for name in ("edoras_radio_link", "edoras_radio_log", "edoras_radio_state"):
        sys.modules.pop(name, None)
    for cached in caches:
        cached.cache_clear()


@pytest.fixture(scope="module")
def both(installed, tmp_path_factory):
    """A function: what either reader says of payloads to the radio's port."""
    path = tmp_path_factory.mktemp("any") / "any.pcap"

    def read(payloads):
        context = Context()
        (batch,) = open_file(write(path, payloads)).batches()
        columns = ColumnDecoder(context).decode(batch)
        dissector = Dissector(Context())
        return columns, [dissector.dissect(batch[row]) for row in range(len(batch))]

    return read


@given(st.lists(st.one_of(st.binary(max_size=40), st.binary(max_size=40).map(MAGIC.__add__)), min_size=1))
def test_any_bytes_are_read_alike_and_raise_nothing(both, installed, payloads):
    columns, decoded = both(payloads)
    for row, (payload, one) in enumerate(zip(payloads, decoded, strict=True)):
        mine = payload.startswith(MAGIC) and len(payload) >= 6
        assert (one.link is installed) == mine == (columns.link[row] == installed)
        assert int(one.findings) == int(columns.findings[row])
        assert one.stop is None or isinstance(one.stop, WireError)
        packet = one.layer("ccsds")
        start = int(columns.packet_offset[row])
        assert (packet is not None) == (start >= 0)


def test_kinds_and_masks_know_it(installed):
    codes = np.array([0, 1, 2, 3, 4, 64], np.uint8)
    assert table.among(codes, lambda link: link.packets).tolist() == [False, True, True, True, False, True]
    assert table.link(64) is installed


@pytest.mark.quick("wrong*")
@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("wrong = edoras_radio_link:RADIO", "its label is 'radio'"),
        ("radio = edoras_radio_link:HEADER", "not an object of a class made from LinkProtocol"),
        ("radio = edoras_radio_link:MISSING", "cannot be loaded"),
    ],
)
def test_a_link_that_breaks_the_rules_is_refused_in_one_line(site, tmp_path, text, said):
    shutil.copytree(site, tmp_path / "site")
    (entries,) = (tmp_path / "site").glob("*.dist-info/entry_points.txt")
    entries.write_text(f"[edoras.links]\n{text}\n")
    done = subprocess.run(
        [EDORAS, "info", SAMPLES / "captures/a_rover.pcap"],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "site")},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "edoras-radio-link" in line
    assert said in line


def test_a_name_that_is_no_link_is_refused():
    with pytest.raises(ConfigError, match="'warp' is not a link; there are ci, to, sbn, robot"):
        table.link_of_label("warp")
