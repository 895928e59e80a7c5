"""``edoras files``: EDORAS's own CFDP entity at both ends of ``edoras proxy`` with losses; hostile names."""

import json
import os
import random
import threading
import time
from contextlib import ExitStack
from types import SimpleNamespace

import cfdp as peer
import pytest
from cfdp.filestore import NativeFileStore
from cfdp.transport.udp import UdpTransport
from pdus import eof, metadata, piece, with_crc
from places import ROOT
from rewriting import Udp, write
from waiting import HOST, Program, free_ports, until

from edoras_tools.addons.cfdp.link import Directive
from edoras_tools.addons.cfdp.taking import safe_path, take_out
from edoras_tools.io.outputs import lock_older
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.wire import cfe

SIZES = (60_000, 59_999, 50_000, 40_001, 60_000, 1)
ENDS = (HOST, 5111), (HOST, 5222)


class Entity:
    """An entity that notes what it sends and gets: (time, PDU)."""

    def __init__(self, number, folder, port, towards):
        self.sent, self.got = [], []
        self._speaks, self._one_at_a_time = True, threading.Lock()
        transport = UdpTransport(routing={"*": [(HOST, towards)]})
        self._send, transport.request = transport.request, self._note
        self.files = folder
        self.files.mkdir()
        self.kernel = peer.CfdpEntity(
            number,
            NativeFileStore(str(folder)),
            transport,
            positive_ack_timer_interval=0.3,
            positive_ack_timer_expiration_limit=50,
            nak_timer_interval=0.3,
            nak_timer_expiration_limit=50,
        )
        indication = transport.indication
        transport.indication = lambda pdu: (self.got.append((time.time_ns(), bytes(pdu))), indication(pdu))
        transport.bind(HOST, port)

    def _note(self, pdu):
        with self._one_at_a_time:
            if self._speaks:
                self.sent.append((time.time_ns(), bytes(pdu)))
                self._send(pdu)

    def hush(self):
        """Send nothing more; its timers go on after a transfer."""
        with self._one_at_a_time:
            self._speaks = False

    def close(self):
        self.kernel.shutdown()
        self.kernel.transport.unbind()


def parts(pdu):
    """Return the sequence number, the directive code (0: a piece of a file), and what follows."""
    width, count = 1 + (pdu[3] >> 4 & 7), 1 + (pdu[3] & 7)
    at = 4 + 2 * width + count
    number = int.from_bytes(pdu[4 + width : 4 + width + count], "big")
    return (number, 0, pdu[at:]) if pdu[0] & 0x10 else (number, pdu[at], pdu[at + 1 :])


def pieces(noted):
    """Return (sequence number, offset, size) of each piece of a file."""
    found = [(number, body) for number, code, body in (parts(pdu) for _, pdu in noted) if not code]
    return [(number, int.from_bytes(body[:4], "big"), len(body) - 4) for number, body in found]


def told_finished(noted):
    return {number for number, code, _ in (parts(pdu) for _, pdu in noted) if code == Directive.FINISHED}


def counted(noted):
    """Count pieces by a plain rule: resent have no new byte, filled have one before the last one known."""
    known, resent, filled = {}, 0, 0
    for number, offset, size in pieces(noted):
        have = known.setdefault(number, set())
        new = set(range(offset, offset + size)) - have
        resent += not new
        filled += bool(new) and offset <= max(have, default=-1)
        have |= new
    return {"segments": len(pieces(noted)), "resent": resent, "filled": filled}


def totals(report):
    return {
        name: sum(item[name] for item in report["transactions"]) for name in ("segments", "resent", "filled")
    }


def test_both_ends_through_a_proxy_that_drops_a_tenth(command, call, tmp_path):
    chance = random.Random(4)
    ground, flight, listen, bind = free_ports(4)
    record = tmp_path / "x.mcap"
    ways = ("--listen", f"{HOST}:{listen}", "--target", f"{HOST}:{flight}", "--bind", f"{HOST}:{bind}")
    how = ("--client", f"{HOST}:{ground}", "--fault", "drop:10%", "--seed", "3", "-o", record, "--json")
    how = (*how, "--port", f"cfdp:{ground}")
    with ExitStack() as opened:
        proxy = opened.enter_context(Program(command, "proxy", "cfdp", *ways, *how))
        assert proxy.line(proxy.err).startswith("relaying cfdp")
        sender = Entity(1, tmp_path / "ground", ground, listen)
        opened.callback(sender.close)
        receiver = Entity(2, tmp_path / "flight", flight, bind)
        opened.callback(receiver.close)
        for number, size in enumerate(SIZES):
            (sender.files / f"scan_{number}").write_bytes(chance.randbytes(size))
            names = {"source_filename": f"/scan_{number}", "destination_filename": f"/data_{number}"}
            sent = sender.kernel.put(2, transmission_mode=peer.TransmissionMode.ACKNOWLEDGED, **names)
            until(lambda sent=sent: sender.kernel.is_complete(sent), "the transfer")
        until(
            lambda: len(told_finished(sender.got)) == len(SIZES),
            "Finished",
        )
        for entity in (sender, receiver):
            entity.hush()
        told = json.loads(proxy.end()[0])

        def dropped():
            return sum(len(entity.sent) - len(entity.got) for entity in (sender, receiver))

        until(lambda: told["faults"][0]["struck"] == dropped(), lambda: f"{dropped()} dropped, {told}")
        assert dropped() > 3

    behind = call("files", record, "-o", tmp_path / "out", "--json").json()
    assert len(behind["transactions"]) == len(SIZES)
    for number, item in enumerate(behind["transactions"]):
        original = (sender.files / f"scan_{number}").read_bytes()
        assert (receiver.files / f"data_{number}").read_bytes() == original
        assert (tmp_path / f"out/data_{number}").read_bytes() == original
        assert (item["state"], item["checksum_right"], item["holes"]) == ("finished", True, 0)
    assert totals(behind) == counted(receiver.got)

    both = sorted(
        [(at, *ENDS, pdu) for at, pdu in sender.sent] + [(at, *ENDS[::-1], pdu) for at, pdu in receiver.sent],
        key=lambda item: item[0],
    )
    in_front = call("files", write(tmp_path / "front.pcap", [Udp(*item) for item in both]), "--json").json()
    assert totals(in_front) == counted(sender.sent)
    assert totals(in_front)["resent"] > 0

    config = tmp_path / "cf.yaml"
    config.write_text("cf: {ros__parameters: {cfdp: {msg_ids: [0x18C8, 0x8C2]}}}")
    packed = write(tmp_path / "packets.pcap", map(in_packet, both))
    inside = call("files", packed, "-c", config, "-o", tmp_path / "cf", "--json").json()
    assert [item | {"path": None} for item in inside["transactions"]] == in_front["transactions"]
    for number in range(len(SIZES)):
        assert (tmp_path / f"cf/data_{number}").read_bytes() == (tmp_path / f"out/data_{number}").read_bytes()


def in_packet(item):
    """Return a PDU in a command to CI, or back in telemetry from TO, as cFS's CF app has them."""
    at, source, _, pdu = item
    if source == ENDS[0]:
        return Udp(at, (HOST, 40000), (HOST, 1234), cfe.emit_command(0x18C8, 0, pdu))
    return Udp(at, (HOST, 49152), (HOST, 1235), cfe.emit_telemetry(0x8C2, pdu, seconds=1, sequence_count=1))


def transfer(name, content, number=7, *, checksum=None, kind=0):
    yield metadata(len(content), name, number, checksum_type=kind, acknowledged=False)
    yield piece(0, content, number, acknowledged=False)
    yield eof(content, number, checksum=checksum, acknowledged=False)


@pytest.fixture
def capture(tmp_path):
    def make(*payloads):
        items = [Udp(number, *ENDS, payload) for number, payload in enumerate(payloads)]
        return write(tmp_path / "x.pcap", items)

    return make


NAMES = {
    b"../../etc/passwd": None,
    b"/etc/passwd": "etc/passwd",
    b"a/../../b": None,
    b"..": None,
    b"a//b": None,
    b".": None,
    b"": None,
    b"a\\..\\b": None,
    b"a\0b": None,
    b"\x1b[2J": None,
    b"x" * 255: None,
    b"data/scan 1.bin": "data/scan 1.bin",
}


def test_names_that_lead_outside_are_refused(call, capture, tmp_path):
    path = capture(*(item for number, name in enumerate(NAMES) for item in transfer(name, b"root", number)))
    out = tmp_path / "deep/er/out"
    result = call("files", path, "-o", out)
    assert result.code == 0
    expected = {wanted or f"1_{number}" for number, wanted in enumerate(NAMES.values())}
    assert {str(item.relative_to(out)) for item in out.rglob("*") if item.is_file()} == expected
    assert {item.name for item in tmp_path.rglob("*") if item.is_file()} == {
        *(name.rpartition("/")[2] for name in expected),
        "x.pcap",
    }
    assert "the name '../../etc/passwd' is refused" in result.out
    assert "\x1b" not in result.out
    assert [safe_path(name.decode()) is None for name in NAMES] == [
        wanted is None for wanted in NAMES.values()
    ]


def test_the_same_name_again_and_a_file_where_a_folder_is_needed(call, capture, tmp_path):
    first, again = transfer(b"a", b"one", 1), transfer(b"a", b"two", 2)
    path = capture(*first, *again, *transfer(b"a/b", b"three", 3), *transfer(b"a", b"four", 4))
    assert call("files", path, "-o", tmp_path / "out").code == 0
    found = {item.name: item.read_bytes() for item in (tmp_path / "out").iterdir()}
    assert found == {"a": b"one", "a.2": b"two", "1_3": b"three", "a.3": b"four"}


CHECKSUMS = (
    (3, 0xCBF43926, True),
    (3, 0, False),
    (2, 0xE3069283, True),
    (2, 0xCBF43926, False),
    (15, 0, None),
    (9, 5, None),
)
"""Types of SANA's registry, the checksum of ``123456789`` or another, and whether it is right."""


def test_what_is_missing_or_wrong_is_told_with_3(call, capture, tmp_path):
    begin, middle, end = transfer(b"a", b"x" * 10)
    result = call("files", capture(begin, middle), "-o", tmp_path / "1")
    assert (result.code, "not finished" in result.out) == (3, True)
    assert [item.name for item in (tmp_path / "1").iterdir()] == ["a.incomplete"]
    result = call("files", capture(*transfer(b"a", b"x" * 10, checksum=5)), "-o", tmp_path / "2")
    assert (result.code, "wrong checksum" in result.out) == (3, True)
    for kind, checksum, right in CHECKSUMS:
        path = capture(*transfer(b"a", b"123456789", checksum=checksum, kind=kind))
        report = call("files", path, "-o", tmp_path / f"crc_{kind}_{checksum}", "--json")
        assert report.code == (3 if right is False else 0)
        (found,) = report.json()["transactions"]
        assert (found["checksum_type"], found["checksum_right"]) == (kind, right)
    assert "finished, checksum of unknown type 9" in call("files", path).out
    far = piece((1 << 31) - 1, b"far", acknowledged=False)
    assert call("files", capture(begin, far, end), "-o", tmp_path / "3").code == 3
    (sparse,) = (tmp_path / "3").iterdir()
    assert sparse.stat().st_size == (1 << 31) + 2
    assert sparse.stat().st_blocks < 1000


def test_a_pdu_with_a_wrong_crc_is_counted_and_not_taken(call, capture, tmp_path):
    begin, middle, end = map(with_crc, transfer(b"a", b"content"))
    wrong = middle.replace(b"content", b"c0ntent")
    result = call("files", capture(begin, wrong, end), "-o", tmp_path / "lost")
    assert (result.code, result.out.splitlines()[-1]) == (3, "1 PDU with a wrong CRC not taken")
    report = call("files", capture(begin, wrong, middle, wrong, end), "-o", tmp_path / "out", "--json").json()
    assert (report["corrupt"], report["transactions"][0]["segments"]) == (2, 1)
    assert (tmp_path / "out/a").read_bytes() == b"content"
    alone = call("files", capture(wrong)).out
    assert alone == "no CFDP transaction\n1 PDU with a wrong CRC not taken\n"


def test_what_a_killed_program_left_is_in_nobody_s_way(call, capture, tmp_path):
    left = tmp_path / "out/.edoras.part"
    left.mkdir(parents=True)
    (left / "0").write_bytes(b"left")
    path = capture(*transfer(b"a", b"x"))
    lock = lock_older(left)
    result = call("files", path, "-o", tmp_path / "out")
    assert (result.code, "another program is writing it" in result.err[0]) == (1, True)
    os.close(lock)
    assert call("files", path, "-o", tmp_path / "out").code == 0
    assert [(item.name, item.read_bytes()) for item in (tmp_path / "out").iterdir()] == [("a", b"x")]


def test_a_folder_that_is_not_empty_is_left_alone(call, capture, tmp_path):
    result = call("files", capture(*transfer(b"a", b"x")), "-o", tmp_path)
    assert (result.code, result.err) == (1, [f"edoras: {tmp_path}: is not empty; name a new folder"])
    assert [item.name for item in tmp_path.iterdir()] == ["x.pcap"]


def test_a_capture_without_a_transaction(call):
    assert call("files", ROOT / "samples/captures/a_rover.pcap").out == "no CFDP transaction\n"


def test_progress_is_told_while_it_is_read():
    source = open_files([ROOT / "samples/captures/a_rover.pcap"])
    read = []
    progress = SimpleNamespace(read=lambda item: read.append(item.statistics.datagrams))
    take_out(source, Settings().workbench(source.info), progress=progress)
    assert read[-1] == 1827
