"""What is fuzzed: functions from bytes to a behaviour, which raise when something is wrong with the code.

A behaviour is any hashable value; bytes that show a new one are worth mutating further.
"""

from __future__ import annotations

import json
import struct
import tempfile
from contextlib import closing
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fuzz_commands
import fuzz_inputs
import fuzz_links
import fuzz_traffic
import numpy as np
from mcap.reader import NonSeekingReader, make_reader
from rich.console import Console as StringConsole
from schema import check, published

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.report.page import page
from edoras_tools.addons.runs.comparison import compare_captures
from edoras_tools.addons.runs.differences import (
    DifferenceLimits,
    RunSummary,
    compare_runs,
    comparison_json,
)
from edoras_tools.addons.runs.views import runs_view
from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.decode.lines import line_of
from edoras_tools.diagnosis.evidence.clocks.alignment import Side, align
from edoras_tools.diagnosis.evidence.table import Recorder
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.missing import missing
from edoras_tools.diagnosis.summary import summarize
from edoras_tools.errors import CaptureError, ConfigError, FieldError, WireError
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.formats.recover import repair
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.mission import Mission, load, loads
from edoras_tools.model import NO_MSG_ID, Finding
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.packet_json import as_json
from edoras_tools.render.capture import tree as packet_view
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.doctor import diagnosis as view
from edoras_tools.render.pages import Origin
from edoras_tools.ros import TypeStore
from edoras_tools.wire.arrays import PADDING

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

ROOT = Path(__file__).parents[2]
TYPES = TypeStore()
_RAW_IP = 101


def _mission(*names: str) -> Mission:
    return load([ROOT / f"samples/missions/{name}.yaml" for name in names])


_ROVER = _mission("rover_ground")
_TWO = _mission("two_rovers_ground", "two_rovers_flight")
_ARMS = _mission("two_arms_ground", "two_arms_flight")
ROOMS = [
    *((port, mission, Options()) for mission in (_ROVER, _TWO, _ARMS) for port in (1234, 1235, 2234)),
    (2236, Mission(), Options()),
    (8080, Mission(), Options()),
    *((port, _TWO, Options(extended_header=True)) for port in (1234, 1235, 2234)),
    (1235, _ROVER, Options(telemetry_header=12)),
    *((1234, _ROVER, Options(envelope=name)) for name in ("auto", "4/4 le", "4/4 be", "8/8 be", "1/1")),
]
"""Where a payload may arrive: port, mission and options; the first byte of an input chooses."""

MESSAGES = [
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/PoseStamped",
    "sensor_msgs/msg/JointState",
    "sensor_msgs/msg/PointCloud2",
    "nav_msgs/msg/Odometry",
    "std_msgs/msg/String",
    "std_msgs/msg/Empty",
    "rcl_interfaces/msg/Log",
    "rcl_interfaces/msg/ParameterEvent",
    "edoras_msgs/msg/Datagram",
]
_SCHEMAS = {name: published(name) for name in ("doctor", "against", "compare")}
LINK_TYPES = [1, 113, 276, 0, 108, 101, 228, 229, 147]
SCENARIOS = ("rover", "arm", "two-rovers", "two-arms")


def _frames(link_type: int, frames: list[bytes]) -> FrameBatch:
    lengths = np.array([len(frame) for frame in frames], dtype=np.int32)
    count = len(frames)
    return FrameBatch(
        data=np.frombuffer(b"".join(frames) + bytes(PADDING), dtype=np.uint8),
        number=np.arange(1, count + 1),
        time_ns=np.arange(count, dtype=np.int64) * 1000,
        link_type=np.full(count, link_type, dtype=np.uint16),
        offset=np.cumsum(lengths, dtype=np.int64) - lengths,
        length=lengths,
        original_length=lengths,
    )


def one_line(*messages: str) -> None:
    """See to it that each message is a line, and that there is one."""
    assert messages
    assert all(text and len(text.splitlines()) == 1 for text in messages), "a message is not one line"


def packet(data: bytes) -> Hashable:
    """One UDP payload: both decoders agree on it, and every view of it can be drawn."""
    room = (data[0] if data else 0) % len(ROOMS)
    port, mission, options = ROOMS[room]
    payload = data[1:60_000]
    length = 28 + len(payload)
    head = struct.pack(">BBHHHBBHII", 0x45, 0, length, 0, 0, 64, 17, 0, 0x7F000001, 0x7F000001)
    frame = head + struct.pack(">HHHH", 2236 if port == 2234 else 40000, port, length - 20, 0) + payload
    batch = Demux().demux(_frames(_RAW_IP, [frame]))
    columns = ColumnDecoder(Context(mission, TYPES, options)).decode(batch)
    decoded = Dissector(Context(mission, TYPES, options)).dissect(batch[0])
    assert decoded.datagram.payload == payload
    assert Finding(int(columns.findings[0])) == decoded.findings, "columns and stack differ in findings"
    assert columns.link[0] == decoded.link, "columns and stack differ in link"
    ccsds = decoded.layer("ccsds")
    msg_id = ccsds.values()["msg_id"] if ccsds else NO_MSG_ID
    assert columns.msg_id[0] == msg_id, "columns and stack differ in MsgId"
    for layer in decoded.layers:
        assert 0 <= layer.start <= layer.end <= len(payload), layer.name
    text = json.dumps(as_json(decoded), allow_nan=False)
    lines = packet_view.packet_lines(decoded, 100, colour=False)
    assert not any(
        ord(letter) < 32
        for line in (*lines, PacketList(100, colour=False).line(line_of(decoded)))
        for letter in line
    )
    shown = json.loads(text)
    return (
        room,
        tuple(shown["layers"]),
        int(decoded.findings),
        (shown["stop"] or "").split(" ")[0],
        decoded.message is not None,
    )


def frames(data: bytes) -> Hashable:
    """Link-layer frames, each behind its length in two bytes; fragments may find each other."""
    link_type = LINK_TYPES[(data[0] if data else 0) % len(LINK_TYPES)]
    given, place = [], 1
    while place + 2 <= len(data) and len(given) < 20:
        (size,) = struct.unpack_from("<H", data, place)
        given.append(data[place + 2 : place + 2 + size])
        place += 2 + size
    if not given:
        return None
    reader = Demux()
    batch = reader.demux(_frames(link_type, given))
    assert len(batch) + reader.skipped == len(given)
    columns = ColumnDecoder(Context(_TWO, TYPES)).decode(batch)
    for row in range(len(batch)):
        datagram = batch[row]
        assert datagram.frame == given[datagram.number - 1]
        Dissector(Context(_TWO, TYPES)).dissect(datagram)
    return link_type, tuple(batch.ip_version), tuple(batch.capture_findings), tuple(columns.link)


def capture(data: bytes) -> Hashable:
    """A file of any kind: what can be read is handed over and can be written again, an error is one line."""
    with (
        tempfile.NamedTemporaryFile(suffix=".bin") as file,
        tempfile.NamedTemporaryFile(suffix=".pcapng") as copy,
    ):
        file.write(data)
        file.flush()
        kind, count, failure = _read_and_copy(file.name, copy.name)
        if count and failure is None:
            again = _read_and_copy(copy.name, None)
            assert again == ("pcapng", count, None), again
        words = failure.replace(file.name, "").partition("(")[0] if failure else ""
        return kind, min(count, 4), "".join(letter for letter in words if not letter.isdigit())


def _read_and_copy(name: str, copy: str | None) -> tuple[str, int, str | None]:
    """Return the kind of a file, the datagrams in it and what went wrong."""
    count = 0
    kind = ""
    try:
        with closing(open_file(name)) as source:
            kind = source.info.kind
            sink = PcapngSink(copy) if copy else None
            try:
                for batch in source.batches():
                    count += len(batch)
                    ColumnDecoder(Context(Mission(), TYPES)).decode(batch)
                    if len(batch):
                        assert batch[len(batch) - 1].number >= len(batch)
                        if sink and batch.time_ns.min() >= 0:
                            sink.write(batch)
                        elif sink:
                            count = -(1 << 62)
            finally:
                if sink:
                    sink.close()
    except CaptureError as error:
        one_line(str(error))
        return kind, max(count, 0), str(error)
    return kind, max(count, 0), None


def recover(data: bytes) -> Hashable:
    """A damaged recording: what is written is whole, by mcap's own reader, and is what was said before."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "x.mcap", Path(folder) / "y.mcap"
        source.write_bytes(data)
        try:
            report = repair(source, target)
        except CaptureError as error:
            one_line(str(error))
            assert not target.exists(), "an output without a message"
            return str(error).partition(":")[2][:30]
        assert repair(source, None) == report, "verified and recovered are not the same"
        if report.whole:
            return "whole", report.unproved > 0
        with target.open("rb") as file:
            found = sum(1 for _ in NonSeekingReader(file, validate_crcs=True).iter_messages())
            file.seek(0)
            # By its index mcap finds only the messages in chunks.
            assert sum(1 for _ in make_reader(file, validate_crcs=True).iter_messages()) <= found
        assert found == sum(report.messages.values()), "the report and the result differ"
        again = repair(target, None)
        assert again.whole, again.reasons
        assert report.lost or report.lost_messages == 0
        return len(report.messages), report.left_out > 0, report.lost, tuple(report.reasons)


def mission(data: bytes) -> Hashable:
    """A mission file: a mission, or all of its mistakes, a line each."""
    try:
        made = loads({"mission.yaml": data}, check_type=TYPES.check)
    except ConfigError as error:
        one_line(*error.mistakes)
        return tuple(sorted({line.rpartition(": ")[2][:20] for line in error.mistakes}))
    return len(made.routes), len(made.links)


def message(data: bytes) -> Hashable:
    """A CDR message: the values say the same written and read again, and columns accept the same bytes."""
    name = MESSAGES[(data[0] if data else 0) % len(MESSAGES)]
    cdr = data[1:]
    buffer = np.frombuffer(cdr + bytes(PADDING), dtype=np.uint8)
    accepted = bool(
        TYPES.columns(name, buffer, np.zeros(1, dtype=np.int64), np.array([len(cdr)], dtype=np.int32)).valid[
            0
        ]
    )
    try:
        values = TYPES.decode(name, cdr)
    except WireError as error:
        assert not accepted, "columns accept what decode refuses"
        return name, type(error).__name__, str(error)[:12]
    assert accepted, "columns refuse what decode accepts"
    try:
        again = TYPES.decode(name, TYPES.encode(name, values))
    except FieldError as error:
        # Strings may hold what no string may be given.
        return name, str(error)[:20]
    assert repr(again) == repr(values), "written and read again it differs"
    return name, tuple(sorted(values)), min(len(cdr), 64)


def session(data: bytes) -> Hashable:
    """Datagrams for the emulated cFS, each behind a byte for the port and one for its length."""
    simulation = Simulation(scenario=SCENARIOS[(data[0] if data else 0) % len(SCENARIOS)], start_ns=10**18)
    ports = simulation.endpoints
    place = 1
    kinds = set()
    for _ in range(6):
        if place + 2 > len(data):
            break
        size = data[place + 1]
        simulation.deliver(ports[data[place] % len(ports)], data[place + 2 : place + 2 + size])
        place += 2 + size
        for sent in simulation.run(simulation.now + 300_000_000):
            assert len(sent.payload) <= 65507
            kinds.add((sent.destination.port, sent.payload[:3], len(sent.payload)))
    counters = simulation.cfs.bus.counters
    return simulation.scenario, counters.msg_limits, counters.pipe_overflows, frozenset(kinds)


def hold(value: dict[str, Any], schema: str) -> None:
    """Hold what would be printed as JSON to its schema."""
    check(json.loads(json.dumps({"schema": 1, **value}, allow_nan=False)), _SCHEMAS[schema])


def diagnosis(data: bytes) -> Hashable:
    """Valid packets in any order: doctor, page and comparisons say something, in their schemas."""
    frames = fuzz_traffic.batches(data[1:])
    mission, found, tables, runs = (_ROVER, _TWO, Mission())[(data[0] if data else 0) % 3], [], [], []
    for half in (slice(None), slice(len(frames) // 2, None)):
        context = Context(mission, TYPES)
        examination, table, ledger = Examination(context), Recorder(context), Ledger(mission)
        batch = Demux().demux(frames).take(half)
        if len(batch):
            columns = ColumnDecoder(context).decode(batch)
            examination.add(batch, columns)
            table.add(batch, columns)
            ledger.add(batch, columns)
        found.append(examination.diagnose())
        tables.append(table)
        parts = {"schema": 1, "source": "fuzz", "warnings": [], "summary": summarize(found[-1]).as_json()}
        told = json.loads(json.dumps({**found[-1].as_json(), **parts}, allow_nan=False))
        check(told, _SCHEMAS["doctor"])
        counts = {"source": "fuzz", "datagrams": ledger.datagrams, "routes": ledger.routes()}
        runs.append(RunSummary(counts, told))
    for item in found:
        if item.case is not None:
            json.dumps([entry.as_json() for entry in missing(item.case)], allow_nan=False)
        page(item, "fuzz", Origin("", 0))
        StringConsole(width=100, file=StringIO()).print(view(item, "fuzz", 100))
        assert item.lost >= 0
        assert all(verdict.start_ns <= verdict.end_ns for verdict in item.verdicts)
        assert min(row.all_lost for row in item.balance) >= 0 if item.balance else True
    between = compare_captures(tables[0], tables[1], mission)
    hold(between.as_json(), "against")
    align(*map(Side, tables))
    for good, bad in (runs, runs[::-1]):
        report = comparison_json([good], [bad], compare_runs([good], [bad], DifferenceLimits()))
        check({"schema": 1, **json.loads(json.dumps(report, allow_nan=False))}, _SCHEMAS["compare"])
        StringConsole(width=100, file=StringIO()).print(runs_view(report, 100))
    assert not any(item.differs for item in compare_runs([runs[0]], [runs[0]], DifferenceLimits()))
    return found[0].bad, frozenset(verdict.rule for verdict in found[0].verdicts)


TARGETS: dict[str, Callable[[bytes], Hashable]] = {
    "packet": packet,
    "frames": frames,
    "capture": capture,
    "recover": recover,
    "mission": mission,
    "message": message,
    "session": session,
    "diagnosis": diagnosis,
    **fuzz_inputs.TARGETS,
    **fuzz_links.TARGETS,
    **fuzz_commands.TARGETS,
}
