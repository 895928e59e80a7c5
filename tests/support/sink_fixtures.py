"""What the tests of sinks share: types, a mission, and batches made of anything."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT

from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import load
from edoras_tools.mission.model import Mission, Route
from edoras_tools.model import Columns, PacketBatch, SourceInfo
from edoras_tools.ros import TypeStore

INFO = SourceInfo("made up", "pcap", time_resolution_ns=1000, snap_length=65535)


@pytest.fixture(scope="session")
def types():
    return TypeStore()


@pytest.fixture(scope="session")
def info():
    return INFO


@pytest.fixture(scope="session")
def mission():
    """Three routes, one of them on the Software Bus Network."""
    routes = (
        Route("/cmd_vel", "geometry_msgs/msg/Twist", 0x1827, CI, "command"),
        Route("/pose", "geometry_msgs/msg/PoseStamped", 0x0827, TO, "telemetry"),
        Route("/robot_1/pose", "geometry_msgs/msg/PoseStamped", 0x1829, SBN, "command"),
    )
    return Mission(routes=routes, files={"rover.yaml": b"node: {}\n"})


@pytest.fixture(scope="session")
def capture(types):
    """A function: a sample capture by name and its mission's, as source info, batches and columns."""

    def read(name, *missions):
        mission = (
            load([ROOT / f"samples/missions/{item}.yaml" for item in missions]) if missions else Mission()
        )
        decoder = ColumnDecoder(Context(mission, types, Options()))
        source = open_file(ROOT / f"samples/captures/{name}.pcap")
        batches = list(source.batches())
        source.close()
        columns = [decoder.decode(batch) for batch in batches]
        return SimpleNamespace(
            mission=mission,
            info=source.info,
            statistics=source.statistics,
            batches=batches,
            columns=columns,
            pairs=list(zip(batches, columns, strict=True)),
        )

    return read


@pytest.fixture(scope="session")
def made_up():
    """A function: a batch of random bytes, and columns that a decoder might give for it."""

    def make(seed, lengths, *, start_ns=1_700_000_000_000_000_000, step_ns=1_000_000, routes=3):
        random = np.random.default_rng(seed)
        count = len(lengths)
        length = np.array(lengths, dtype=np.int32)
        offset = np.cumsum(length, dtype=np.int64) - length
        data = random.integers(0, 256, int(length.sum()) + 64, dtype=np.uint8)
        head = np.minimum(random.integers(0, 60, count), length).astype(np.int32)
        time_ns = start_ns + np.cumsum(random.integers(0, step_ns + 1, count))
        ipv6 = tuple(random.bytes(16) for _ in range(3))
        version = random.choice(np.array([4, 6], dtype=np.uint8), count)

        def addresses():
            table = random.integers(0, len(ipv6), count)
            return np.where(version == 6, table, random.integers(0, 1 << 32, count)).astype(np.uint32)

        batch = PacketBatch(
            data=data,
            number=np.arange(1, count + 1),
            time_ns=time_ns,
            link_type=random.choice(np.array([1, 113], dtype=np.uint16), count),
            frame_offset=offset,
            frame_length=length,
            original_length=(length + random.integers(0, 9, count)).astype(np.int32),
            offset=offset + head,
            length=length - head,
            source_address=addresses(),
            source_port=random.integers(0, 1 << 16, count).astype(np.uint16),
            destination_address=addresses(),
            destination_port=random.integers(0, 1 << 16, count).astype(np.uint16),
            ip_version=version,
            capture_findings=np.zeros(count, dtype=np.uint32),
            ipv6=ipv6,
        )
        route = random.integers(-1, routes, count).astype(np.int16)
        carried = random.integers(0, length - head + 1).astype(np.int32)
        present = random.random(count) < 0.8
        columns = Columns(
            link=random.integers(0, 4, count).astype(np.uint8),
            spacecraft=np.ones(count, np.uint8),
            sbn_msg_type=np.full(count, -1, dtype=np.int16),
            processor_id=random.integers(0, 3, count).astype(np.uint32),
            spacecraft_id=np.full(count, 66, dtype=np.uint32),
            packet_offset=offset + head,
            packet_length=length - head,
            msg_id=random.choice(np.array([-1, 0x1827, 0x0827, 0x08F0], dtype=np.int32), count),
            sequence_flags=np.full(count, 3, dtype=np.uint8),
            sequence_count=random.integers(0, 1 << 14, count).astype(np.uint16),
            function_code=np.full(count, -1, dtype=np.int16),
            mission_time_ns=np.where(random.random(count) < 0.5, time_ns // 7, -1),
            header_length=np.full(count, 16, dtype=np.uint8),
            headers=np.zeros(count, dtype=np.uint8),
            cdr_offset=offset + head,
            cdr_length=np.where(present, carried, 0).astype(np.int32),
            route=route,
            findings=random.choice(np.array([0, 1 << 7, 1 << 4, 1 << 8], dtype=np.uint32), count),
        )
        return batch, columns

    return make
