"""One recording with six links: each is sent as it is told, and the rest is named with its option."""

import socket

import pytest
import yaml
from pdus import eof, finished, metadata, nak, piece
from places import SAMPLES
from rewriting import Udp, datagrams, write
from spacepackets.ccsds.tm_frame import TmTransferFrame
from transfer_frames import Maker, space_packet
from waiting import HOST, Ear

ROVER = SAMPLES / "captures/a_rover.pcap"
FPRIME = SAMPLES / "fprime/rover.pcap"


class Six:
    """A recording with traffic of six links, and a mission that says where frames are."""

    port = 5700

    def __init__(self, folder):
        maker, begin = Maker("tm", 200), datagrams(ROVER)[0].time_ns
        self.rover = [item for item in datagrams(ROVER) if item.destination[1] in {1234, 1235, 2234, 2236}][
            :400
        ]
        self.packets = [space_packet(0x55, bytes(30), count) for count in range(20)]
        self.frames = [frame for frame, _ in maker.carry(self.packets)]
        rows = (metadata, 600, b"scan"), (piece, 0, bytes(400)), (piece, 400, bytes(200)), (eof, bytes(600))
        self.files = [make(*words, acknowledged=False) for make, *words in rows]
        self.gds = [item.payload for item in datagrams(FPRIME)]
        ends = {"frames": ("10.0.0.2", self.port), "files": (HOST, 5222), "gds": (HOST, 50000)}
        more = [
            Udp(begin + 10**6 * place, (HOST, 40000), ends[name], payload)
            for name in ends
            for place, payload in enumerate(getattr(self, name))
        ]
        self.answers = [nak((0, 10)), finished()]
        more += [Udp(begin + 10**9, (HOST, 5222), (HOST, 5111), item) for item in self.answers]
        self.path = write(folder / "six.pcap", sorted([*self.rover, *more], key=lambda item: item.time_ns))
        mission = yaml.safe_load((SAMPLES / "missions/rover_ground.yaml").read_text())
        frames = {"down": {"port": self.port, **maker.format()}}
        next(iter(mission.values()))["ros__parameters"]["frames"] = frames
        self.mission = folder / "six.yaml"
        self.mission.write_text(yaml.safe_dump(mission))
        self.up = [item for item in self.gds if item[0] >> 4 == 2]

    def to(self, *ports):
        return [item.payload for item in self.rover if item.destination[1] in ports]


@pytest.fixture(scope="module")
def six(tmp_path_factory):
    return Six(tmp_path_factory.mktemp("six"))


def left_out(six, *without):
    """Return the note on what is not sent, in the order of the links' codes."""
    sbn = len(six.to(2234, 2236))
    counts = {
        "CI": (len(six.to(1234)), "ci"),
        "TO": (len(six.to(1235)) + len(six.packets), "ground"),
        "SBN": (sbn, "sbn"),
        "CFDP": (len(six.files) + len(six.answers), "cfdp"),
        "FRAMES": (len(six.frames), "frames"),
        "FPRIME": (len(six.gds), "fprime"),
    }
    return [f"{count:,} of {name} (--to {to})" for name, (count, to) in counts.items() if name not in without]


def test_of_six_links_each_is_sent_as_told_and_the_rest_is_named(six, call):
    """What reaches a port is what the recording has of that link; the others are named with their options."""
    expected = {
        "ci": (six.to(1234), "CI"),
        "ground": (six.to(1235) + six.packets, "TO"),
        "cfdp": (six.files, "CFDP"),
    }
    for to, (payloads, name) in expected.items():
        with Ear() as ear:
            where = (
                "--target",
                f"{HOST}:{ear.port}",
                "--linger",
                "0s",
                "--no-listen",
                "--json",
                "--speed",
                "max",
            )
            done = call("replay", six.path, "--to", to, "-c", six.mission, *where)
            got = ear.take()
        assert done.code == 0, done.err
        note = done.json()["notes"][-1]
        assert note.startswith("left out: ")
        assert sorted(left_out(six, name)) == sorted(
            part for part in note.removeprefix("left out: ").split(", ")
        )
        number = 5 if to == "cfdp" else 0  # the byte of a PDU that is new: its transaction
        assert [item[:number] + item[number + 1 :] for item in got if number] == [
            item[:number] + item[number + 1 :] for item in payloads if number
        ]
        assert number or sorted(got) == sorted(payloads)


def test_of_six_links_streams_and_frames_too(six, call):
    for to, frames in (("fprime", [item for item in six.gds if item not in six.up]), ("fprime:up", six.up)):
        with socket.create_server((HOST, 0)) as server:
            where = (
                "--target",
                f"{HOST}:{server.getsockname()[1]}",
                "--linger",
                "0s",
                "--json",
                "--speed",
                "max",
            )
            done = call("replay", six.path, "--to", to, "-c", six.mission, *where)
            assert done.code == 0, done.err
            connection, data = server.accept()[0], b""
            with connection:
                while more := connection.recv(65536):
                    data += more
        assert data == b"".join(frames)
    with Ear() as ear:
        where = ("--target", f"{HOST}:{ear.port}", "--linger", "0s", "--json", "--speed", "max")
        done = call("replay", six.path, "--to", "frames", "-c", six.mission, *where)
        got = ear.take()
    data = b"".join(TmTransferFrame.unpack(item, len(item), True).data_field for item in got)
    assert done.code == 0, done.err
    assert [item for item in inside(data) if item[:2] == six.packets[0][:2]] == six.packets


def inside(data):
    """Return the packets that follow each other."""
    at = 0
    while at + 6 <= len(data):
        size = int.from_bytes(data[at + 4 : at + 6], "big") + 7
        yield bytes(data[at : at + size])
        at += size


def test_of_six_links_what_is_not_there_is_refused_with_what_is(six, call):
    done = call("replay", six.path, "--to", "racs2", "-c", six.mission, "--dry-run")
    assert done.code == 1
    assert "contains no messages for racs2; it has " in done.err[-1]
    assert all(part in done.err[-1] for part in left_out(six))
