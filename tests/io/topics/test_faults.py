"""``/edoras/faults``: written beside the datagrams, read back by the mcap library and the type store."""

from contextlib import closing

from mcap.reader import make_reader

from edoras_tools.io.formats.mcap.reader import McapSource
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.topics.edoras import FAULTS_TOPIC
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission
from edoras_tools.model import NO_MSG_ID, SourceInfo, SourceStatistics
from edoras_tools.ros import TypeStore
from edoras_tools.sessions.faults.rules import Fault

NOON = 1_700_000_000_123_456_789
FAULTS = [
    Fault(NOON, "drop", "dropped", b"\x18\x27", CI, True, 0x1827, "drop:0.1"),
    Fault(NOON + 5, "corrupt", "bit 3 turned over", b"", SBN, False, NO_MSG_ID, "corrupt:1"),
    Fault(NOON + 9, "überlauf", "", bytes(range(256)), TO, False, 0x0827, ""),
]


def faults_of(path):
    types = TypeStore()
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages([FAULTS_TOPIC]):
            assert channel.message_encoding == "cdr"
            yield message.log_time, types.decode(schema.name, message.data)


def test_what_was_done_on_purpose_is_in_the_recording_as_what_it_was(tmp_path):
    path = tmp_path / "a.mcap"
    sink = McapSink(path, Mission(), TypeStore(), SourceInfo("x", "proxy"))
    sink.write_faults(FAULTS[:2])
    sink.write_faults(FAULTS[2:])
    sink.close(SourceStatistics())
    read = list(faults_of(path))
    assert [time for time, _ in read] == [fault.time_ns for fault in FAULTS]
    with closing(McapSource(path)) as source:
        assert source.faults() == FAULTS
    for (time_ns, values), fault in zip(read, FAULTS, strict=True):
        assert values["stamp"] == {"sec": time_ns // 10**9, "nanosec": time_ns % 10**9}
        assert (values["kind"], values["detail"], values["rule"]) == (fault.kind, fault.detail, fault.rule)
        assert (values["link"], values["to_cfs"], values["msg_id"]) == (
            fault.link,
            fault.to_cfs,
            fault.msg_id,
        )
        assert bytes(values["original"]) == fault.original


def test_a_recording_without_faults_has_no_such_topic(tmp_path):
    path = tmp_path / "a.mcap"
    McapSink(path, Mission(), TypeStore(), SourceInfo("x", "proxy")).close(SourceStatistics())
    with path.open("rb") as file:
        topics = {channel.topic for channel in make_reader(file).get_summary().channels.values()}
    assert FAULTS_TOPIC not in topics
