"""Files of a recording reach an entity of another implementation in new transactions, through loss."""

import random
import time

import cfdp as peer
import pytest
from cfdp.filestore import NativeFileStore
from cfdp.transport.udp import UdpTransport
from pdus import eof, metadata, piece, with_crc
from rewriting import Udp, write
from waiting import HOST, Ear, free_ports, until

from edoras_tools.wire.arrays import crc16

CONTENTS = {7: random.Random(1).randbytes(20_000), 8: b"short", 9: random.Random(2).randbytes(9_001)}


@pytest.fixture
def entity(tmp_path):
    """The receiver: entity 2, which loses a share of what comes."""
    port, back = free_ports(2)
    folder = tmp_path / "received"
    folder.mkdir()
    transport = UdpTransport(routing={"*": [(HOST, back)]})
    kernel = peer.CfdpEntity(
        2,
        NativeFileStore(str(folder)),
        transport,
        positive_ack_timer_interval=0.3,
        nak_timer_interval=0.3,
        nak_timer_expiration_limit=50,
    )
    chance, take = random.Random(4), transport.indication
    transport.numbers = set()

    def lossy(pdu):
        pdu = bytes(pdu)
        transport.numbers.add(pdu[5])
        if chance.random() >= transport.loss:
            take(bytearray(pdu))

    transport.loss, transport.indication = 0.0, lossy
    transport.bind(HOST, port)
    ways = ("--to", "cfdp", "--target", f"{HOST}:{port}", "--listen", f"{HOST}:{back}", "--json")
    yield transport, folder, ways
    kernel.shutdown()
    transport.unbind()


def recording(path, *, acknowledged, crc=False):
    rows = []
    for number, content in CONTENTS.items():
        name = b"file_%d" % number
        how = {"number": number, "acknowledged": acknowledged}
        rows.append(metadata(len(content), name, **how))
        rows += [piece(at, content[at : at + 500], **how) for at in range(0, len(content), 500)]
        rows.append(eof(content, **how))
    rows = [with_crc(item) for item in rows] if crc else rows
    at = time.time_ns()
    items = [Udp(at + 10**6 * row, (HOST, 5111), (HOST, 5222), item) for row, item in enumerate(rows)]
    return write(path, items)


def complete(folder):
    files = {path.name: path.read_bytes() for path in folder.iterdir()}
    return files == {f"file_{number}": content for number, content in CONTENTS.items()}


def test_class_2_through_a_tenth_lost(entity, call, tmp_path):
    transport, folder, ways = entity
    transport.loss = 0.1
    path = recording(tmp_path / "files.pcap", acknowledged=True)
    done = call("replay", path, *ways, "--linger", "500ms")
    assert done.code == 0, done.err
    until(lambda: complete(folder), "the files are there")
    assert done.json()["notes"] == ["3 of 3 files of class 2 were acknowledged as finished"]
    assert not transport.numbers & set(CONTENTS)


def test_class_1_as_it_was(entity, call, tmp_path):
    _, folder, ways = entity
    path = recording(tmp_path / "files.pcap", acknowledged=False)
    done = call("replay", path, *ways, "--linger", "0s")
    assert done.code == 0, done.err
    until(lambda: complete(folder), "the files are there")
    assert done.json()["notes"] == []


def test_what_the_recording_lacks_is_told(entity, call, tmp_path):
    ways = entity[2]
    how = {"number": 7, "acknowledged": True}
    rows = [metadata(1000, b"x", **how), piece(0, bytes(400), **how), eof(bytes(1000), **how)]
    items = [Udp(10**18 + row, (HOST, 5111), (HOST, 5222), item) for row, item in enumerate(rows)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("edoras_tools.addons.cfdp.sending._MOST_TRIES", 2)
        done = call("replay", write(tmp_path / "a.pcap", items), *ways, "--linger", "1s")
    assert "0 of 1 files of class 2" in done.json()["notes"][0]
    assert "bytes that the receiver asked for are not in the recording" in done.json()["notes"][1]


def test_a_crc_is_made_right(tmp_path, call):
    path = recording(tmp_path / "files.pcap", acknowledged=False, crc=True)
    with Ear() as ear:
        call(
            "replay", path, "--to", "cfdp", "--target", f"{HOST}:{ear.port}", "--max", "-q", "--linger", "0s"
        )
        taken = ear.take()
    assert len(taken) == 60 + 6
    assert {crc16(item) for item in taken} == {0}
    assert not {item[5] for item in taken} & set(CONTENTS)
