"""What the tests of the command line share: the commands themselves, and judges that know nothing of them."""

from __future__ import annotations

import gzip
import json
import socket
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import here
import pytest
import warm
from effort import every
from mcap.reader import make_reader
from places import ROOT
from schema import held


@pytest.fixture(scope="session")
def missions():
    """A function: the ``-c`` options of sample missions."""

    def options(*names):
        return [word for name in names for word in ("-c", str(ROOT / f"samples/missions/{name}.yaml"))]

    return options


@pytest.fixture(scope="session")
def captures(tmp_path_factory):
    """A function: the path of a sample capture by name, unpacked where it is shipped packed."""
    folder = tmp_path_factory.mktemp("captures")

    def path(name):
        plain, unpacked = ROOT / f"samples/captures/{name}.pcap", folder / f"{name}.pcap"
        if plain.exists():
            return plain
        if not unpacked.exists():
            unpacked.write_bytes(gzip.decompress(plain.with_suffix(".pcap.gz").read_bytes()))
        return unpacked

    return path


@pytest.fixture(scope="session")
def command():
    """The path of the installed command."""
    return str(warm.EDORAS)


@pytest.fixture(scope="session")
def edoras():
    """A function: run the command in a process; its result is ``subprocess.run``'s."""
    return warm.run


@pytest.fixture
def call(monkeypatch, capsys):
    """A function: run a command here; gives ``code``, ``out``, ``err`` (lines), ``json()``, ``lines()``.

    What the last two give is held to its published schema; of lines `make test` holds each seventh.
    """

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["edoras", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ending:
            here.edoras()
        out, err = capsys.readouterr()

        def lines(texts):
            values = [json.loads(text) for text in texts]
            for value in every(7, values):
                held(value, sys.argv)
            return values

        return SimpleNamespace(
            code=ending.value.code,
            out=out,
            err=err.splitlines(),
            json=lambda: held(json.loads(out), sys.argv),
            lines=lambda: lines(out.splitlines()),
        )

    return run


@pytest.fixture(scope="session")
def frames():
    """A function: the frames of a little-endian Ethernet pcap file, read by its definition alone."""
    units = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}

    def read(path):
        data = Path(path).read_bytes()
        magic, *_, link_type = struct.unpack_from("<IHHiIII", data)
        assert link_type == 1
        found, place = [], 24
        while place < len(data):
            seconds, rest, captured, original = struct.unpack_from("<IIII", data, place)
            frame = data[place + 16 : place + 16 + captured]
            found.append((seconds * 10**9 + rest * units[magic], frame, original))
            place += 16 + captured
        return found

    return read


@pytest.fixture(scope="session")
def write_pcap():
    """A function: write frames, as ``frames`` gives them, to a pcap file by its definition alone."""

    def write(path, frames):
        records = [
            struct.pack("<IIII", time_ns // 10**9, time_ns // 1000 % 10**6, len(frame), original) + frame
            for time_ns, frame, original in frames
        ]
        header = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
        Path(path).write_bytes(header + b"".join(records))
        return Path(path)

    return write


@pytest.fixture(scope="session")
def datagrams(frames):
    """A function: the datagrams of an Ethernet, IPv4 pcap as time, source and destination port, payload."""

    def read(path):
        found = []
        for time_ns, frame, _ in frames(path):
            assert frame[12:14] == b"\x08\x00"
            assert frame[23] == socket.IPPROTO_UDP
            udp = 14 + 4 * (frame[14] & 15)
            source, destination, length = struct.unpack_from(">HHH", frame, udp)
            found.append(
                SimpleNamespace(
                    time_ns=time_ns,
                    source=source,
                    destination=destination,
                    payload=frame[udp + 8 : udp + length],
                )
            )
        return found

    return read


@pytest.fixture(scope="session")
def recording():
    """A function: what mcap's own reader finds in a recording: messages by topic, schemas, attachments."""

    def read(path):
        with Path(path).open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            topics = {channel.topic: [] for channel in summary.channels.values()}
            for _, channel, message in reader.iter_messages(log_time_order=False):
                topics[channel.topic].append(message)
            return SimpleNamespace(
                summary=summary,
                topics=topics,
                counts={topic: len(messages) for topic, messages in topics.items()},
                attachments={item.name: item.data for item in reader.iter_attachments()},
                metadata={item.name: item.metadata for item in reader.iter_metadata()},
            )

    return read
