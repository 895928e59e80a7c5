"""Files that are an envelope with a message are messages of a recording, once their transfer has finished."""

import pytest
from mcap.reader import make_reader
from pdus import eof, finished, metadata, piece
from rewriting import Udp, write

from edoras_tools.addons.cfdp import transactions
from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.wire.envelope import DEFAULT

ENDS = ("10.0.0.1", 5111), ("10.0.0.2", 5222)
SCAN = "sensor_msgs/msg/LaserScan"
MISSION = """\
/**:
  ros__parameters:
    write_data: ['scan', 'odd']
    read_data: ['back']
    scan: {type: "sensor_msgs/msg/LaserScan", topic: "/robot_1/scan", store_filename: "data/scan_1"}
    back: {type: "sensor_msgs/msg/LaserScan", topic: "/rx/scan", rate: 1000, store_filename: "rcv/scan_1"}
    odd: {type: "nothing/msg/Known", topic: "/odd", store_filename: "odd"}
"""


def scan(number):
    values = {"header": {"frame_id": f"laser {number}"}, "ranges": [number + 0.5] * 300}
    return TypeStore().encode(SCAN, values)


def sent(content, number, name=b"/scan_1", checksum=None):
    """Yield a transfer whose first piece comes last."""
    yield metadata(len(content), name, number)
    yield piece(500, content[500:], number)
    yield eof(content, number, checksum=checksum)
    yield piece(0, content[:500], number)
    yield finished(0, number)


@pytest.fixture
def recorded(tmp_path):
    def make(*payloads):
        items = [
            Udp(1000 + number, *(ENDS[::-1] if payload[0] >> 3 & 1 else ENDS), payload)
            for number, payload in enumerate(payloads)
        ]
        config = tmp_path / "transfer.yaml"
        config.write_text(MISSION)
        target = Target(tmp_path / "x.mcap", replace=True)
        record(open_file(write(tmp_path / "x.pcap", items)), Settings([config]).workbench(), target)
        with target.path.open("rb") as file:
            return [
                (channel.topic, schema.name, message.log_time, message.data)
                for schema, channel, message in make_reader(file).iter_messages()
                if not channel.topic.startswith("/edoras/")
            ]

    return make


def test_a_message_is_written_when_its_transfer_has_finished(recorded):
    one, two = scan(1), scan(2)
    payloads = [*sent(DEFAULT.emit(one), 1), *sent(DEFAULT.emit(two, capacity=9999), 2)]
    assert recorded(*payloads) == [
        ("/robot_1/scan", SCAN, 1000 + 4, one),
        ("/robot_1/scan", SCAN, 1000 + 9, two),
    ]


@pytest.mark.parametrize(
    "payloads",
    [
        list(sent(DEFAULT.emit(scan(1)), 1, b"another")),
        list(sent(DEFAULT.emit(scan(1)), 1, checksum=5)),
        list(sent(DEFAULT.emit(scan(1)), 1))[:-1],
        [item for item in sent(DEFAULT.emit(scan(1)), 1) if item[0] >> 4 & 1 == 0],
        list(sent(b"no envelope" * 100, 1)),
        list(sent(DEFAULT.emit(scan(1)[:600]), 1)),
    ],
    ids=["another name", "wrong checksum", "not finished", "no pieces", "no envelope", "no whole message"],
)
def test_what_is_no_message_is_none(recorded, payloads):
    assert recorded(*payloads) == []


def test_what_is_kept_is_limited(recorded, monkeypatch):
    monkeypatch.setattr(transactions, "MOST_BYTES", 1500)
    content = DEFAULT.emit(scan(1))
    assert 1000 < len(content) < 1500
    first, other = list(sent(content, 1)), list(sent(content, 2))
    both = [item for pair in zip(first, other, strict=True) for item in pair]
    assert len(recorded(*both)) == 1
    assert len(recorded(*first, *other)) == 2
