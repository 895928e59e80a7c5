"""``/edoras/host``: written beside the datagrams, read back by the mcap library and the type store."""

from contextlib import closing

from mcap.reader import make_reader

from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.topics.host import HOST_TOPIC
from edoras_tools.mission import Mission
from edoras_tools.model import HostCounters, SocketCounters, SourceInfo, SourceStatistics
from edoras_tools.ros import TypeStore

NOON = 1_700_000_000_123_456_789
READINGS = [
    HostCounters(
        NOON, (SocketCounters(1234, "127.0.0.1", 7, 512, 80),), 93, 5, 13, 105, 6, 10, 1 << 18, 1 << 22
    ),
    HostCounters(NOON + 10**9, (SocketCounters(2234, "::1", 1 << 40, 0, 0),) * 3),
]


def test_what_the_kernel_counted_is_in_the_recording_as_it_was(tmp_path):
    path = tmp_path / "a.mcap"
    types = TypeStore()
    sink = McapSink(path, Mission(), types, SourceInfo("lo", "live"))
    for reading in READINGS:
        sink.write_host(reading)
    sink.close(SourceStatistics())
    with path.open("rb") as file:
        told = [
            (message.log_time, types.decode(schema.name, message.data))
            for schema, _, message in make_reader(file).iter_messages([HOST_TOPIC])
        ]
    assert [time_ns for time_ns, _ in told] == [reading.time_ns for reading in READINGS]
    assert told[0][1]["sockets"][0] == {
        "inode": 7,
        "drops": 80,
        "queued": 512,
        "port": 1234,
        "address": "127.0.0.1",
    }
    assert (told[0][1]["msg_max"], told[1][1]["msg_max"]) == (10, -1)
    with closing(McapSource(path)) as source:
        assert source.host() == READINGS
