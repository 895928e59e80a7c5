import json
from contextlib import closing

import numpy as np
import pytest
from msgspec.structs import replace
from places import CAPTURES, MISSIONS, ROOT
from rewriting import datagrams, rewritten, write

from edoras_tools.decode import ColumnDecoder, Context, Dissector, Options
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import CI, TO
from edoras_tools.mission import load
from edoras_tools.model import concatenate
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.packet_json import PacketTexts
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.ros import TypeStore
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.envelope import ENVELOPE_FORMATS

ROVER = MISSIONS / "rover_ground.yaml"
TYPES = TypeStore()


def with_headers(payload: bytes, headers: cfe.Headers) -> bytes:
    """Return a usual packet as another build of cFE would send it."""
    command = bool(payload[0] & 0x10)
    agrees = ccsds.PRIMARY.parse(payload)["packet_data_length"] + ccsds.LENGTH_BIAS == len(payload)
    if not agrees or len(payload) < (8 if command else 16) or headers is cfe.STANDARD:
        return payload
    if headers is cfe.SHORT:
        body = payload if command else payload[:12] + payload[16:]
    else:
        qualifier = b"\0\0\0\0" if command else b"\x0c\0\0\x42"
        own, rest = (payload[6:8] + bytes(4), payload[8:]) if command else (payload[6:12], payload[16:])
        body = payload[:6] + qualifier + own + rest
    size = ccsds.PRIMARY.parse(payload)["packet_data_length"] + len(body) - len(payload)
    return body[:4] + size.to_bytes(2, "big") + body[6:]


def with_envelope(payload: bytes, form) -> bytes:
    """Return a packet whose 8/8 envelope is one of another format."""
    at = 8 if payload[0] & 0x10 else 16
    length = int.from_bytes(payload[at : at + 8], "little")
    if not 4 <= length <= len(payload) - at - 16 or length > 255 or payload[at + 16 : at + 20] != b"\0\1\0\0":
        return payload
    body = payload[:at] + form.emit(payload[at + 16 : at + 16 + length]) + payload[at + 16 + length :]
    return body[:4] + (len(body) - ccsds.LENGTH_BIAS).to_bytes(2, "big") + body[6:]


def routes(path, **options):
    settings = Settings([ROVER], options=Options(**options))
    source = open_file(path)
    return inspect(source, settings.workbench(source.info))


@pytest.mark.each(3)
@pytest.mark.parametrize("headers", cfe.DETECTABLE, ids=lambda item: item.name)
def test_the_headers_of_a_real_capture_are_told_from_its_bytes(tmp_path, headers):
    path = rewritten(CAPTURES / "a_rover.pcap", tmp_path / "x.pcap", lambda data: with_headers(data, headers))
    report = routes(path)
    assert [line for line in report.notes if "header" in line] == (
        []
        if headers is cfe.STANDARD
        else [
            (
                f"read with cFE's {headers.name}, as the packets' bytes show; "
                "--set telemetry-header=16 reads them with the usual one"
            )
        ]
    )
    plain = routes(CAPTURES / "a_rover.pcap")
    # A checksum that is absent may be right by chance, and lengths differ.
    own, usual = (
        {
            (row["topic"], row["msg_id"]): {*row["findings"]} - {"checksum_absent"}
            for row in item.ledger.routes()
        }
        for item in (report, plain)
    )
    assert own == usual


def test_an_option_wins_over_the_bytes(tmp_path):
    path = rewritten(
        CAPTURES / "a_rover.pcap", tmp_path / "x.pcap", lambda data: with_headers(data, cfe.WITH_EXTENDED)
    )
    report = routes(path, telemetry_header=16)
    assert report.notes == []
    assert report.ledger.findings["command_length"] > 0


@pytest.mark.each(3)
@pytest.mark.parametrize("form", ENVELOPE_FORMATS, ids=str)
def test_the_envelope_of_a_real_capture_is_told_from_its_bytes(tmp_path, form):
    path = rewritten(CAPTURES / "a_rover.pcap", tmp_path / "x.pcap", lambda data: with_envelope(data, form))
    report = routes(path)
    assert len(report.notes) == (0 if form == ENVELOPE_FORMATS[0] else 2)
    assert all(f"the {form} envelope" in line for line in report.notes)
    assert "cdr_invalid" not in report.ledger.findings
    assert "envelope_overrun" not in report.ledger.findings


def test_a_recording_remembers_what_it_was_made_with(tmp_path):
    path = rewritten(
        CAPTURES / "a_rover.pcap", tmp_path / "x.pcap", lambda data: with_headers(data, cfe.WITH_EXTENDED)
    )
    source = open_file(path)
    bench = Settings([ROVER], options=Options(ports=((CI, 5234),))).workbench(source.info)
    record(source, bench, Target(tmp_path / "x.mcap"))
    with closing(open_file(tmp_path / "x.mcap")) as recording:
        info = recording.info
    assert info.read_with == {"headers": "extended header", "ports": "ci:5234"}
    context = Settings([]).workbench(info).columns.context
    assert context.headers is cfe.WITH_EXTENDED
    assert context.ports[CI][5234]


def test_what_a_recording_remembers_gives_way_to_options_and_may_be_anything():
    assert Options(telemetry_header=12).over({"headers": "extended header"}).headers is cfe.SHORT
    for headers in cfe.HEADERS:
        assert Options().over({"headers": headers.name}).headers is headers
        assert Options().over(Options().with_headers(headers).described()).headers is headers
    odd = {"headers": "?", "envelope": "", "ports": "ci: x:1 to:5000", "more": json.dumps([])}
    assert Options().over(odd) == Options(ports=((TO, 5000),))


def test_live_batches_of_one_are_enough(tmp_path):
    path = rewritten(
        CAPTURES / "a_rover.pcap", tmp_path / "x.pcap", lambda data: with_headers(data, cfe.WITH_EXTENDED)
    )
    decoder = ColumnDecoder(Context(load([ROVER]), TYPES))
    with closing(open_file(path)) as source:
        batch = next(iter(source.batches()))
    for row in range(80):
        decoder.decode(batch.take(np.array([row])))
    assert decoder.context.headers is cfe.WITH_EXTENDED


def two_builds(order):
    """Traffic of two builds of cFE, and how many of its first datagrams are of the first of them."""
    one, other = (
        datagrams(ROOT / f"tests/captures/{name}.pcap.zst")
        for name in ("a_rover", "p6b_extended_header")[::order]
    )
    later = one[-1].time_ns + 10**9 - other[0].time_ns
    return [*one, *(item.at(later) for item in other)], len(one)


@pytest.mark.parametrize("order", [1, -1])
def test_each_conversation_is_read_with_the_headers_of_its_build(tmp_path, order):
    traffic, first = two_builds(order)
    with closing(open_file(write(tmp_path / "x.pcap", traffic))) as source:
        batch = concatenate(list(source.batches()))
    context = Context()
    columns, dissector = ColumnDecoder(context).decode(batch), Dissector(context)
    packets = columns.packet_length > 0
    extended = cfe.HEADERS.index(cfe.WITH_EXTENDED)
    is_extended = (np.arange(len(batch)) >= first) == (order > 0)
    # From port 1235 to 1234 commands of both builds go, of which each has its own headers.
    sbn = columns.sbn_msg_type >= 0
    assert (columns.headers[packets & ~sbn] == np.where(is_extended, extended, 0)[packets & ~sbn]).all()
    for row in np.flatnonzero(packets & ~sbn)[::37].tolist():
        layers = [layer.name for layer in dissector.dissect(batch[row]).layers]
        assert ("cfe_extended" in layers) == bool(is_extended[row])
    (note,) = [line for line in context.notes if " > " in line]
    assert "127.0.0.1:1235 > 127.0.0.1:1234" in note
    assert "16-byte telemetry header or extended header" in note


@pytest.mark.long
def test_a_build_that_comes_late_in_a_long_source_is_found(tmp_path):
    traffic, first = two_builds(1)
    repeated = [item.at(turn * 70 * 10**9) for turn in range(40) for item in traffic[:first]]
    late = [item.at(40 * 70 * 10**9) for item in traffic[first:]]
    context = Context()
    decoder = ColumnDecoder(context)
    with closing(open_file(write(tmp_path / "x.pcap", repeated + late))) as source:
        found = [decoder.decode(batch).headers for batch in source.batches()]
    headers = np.concatenate(found)
    assert not headers[: len(repeated)].any()
    assert (headers[len(repeated) :] != 0).sum() > 800


@pytest.mark.long
@pytest.mark.parametrize("order", [1, -1])
def test_what_one_decoder_detected_another_reads_with(tmp_path, order):
    """Each batch is begun by one and finished by the other, as processes share them."""
    with closing(open_file(write(tmp_path / "x.pcap", two_builds(order)[0]))) as source:
        batch = concatenate(list(source.batches()))
    one, begins, ends = (Settings([ROVER]).workbench().columns for _ in range(3))
    several = 0
    for part in np.array_split(np.arange(len(batch)), 40):
        some = batch.take(part)
        begun = begins.begin(some)
        ends.context.take_over(begins.context.detected)
        expected, found = one.decode(some), ends.finish(some, begun._replace(part=None))
        for name in type(found).__struct_fields__:
            assert np.array_equal(getattr(found, name), getattr(expected, name)), name
        several += ends.context.builds.several
    assert several > 10
    assert ends.context.detected == one.context.detected


def test_headers_that_an_option_names_are_those_of_every_conversation(tmp_path):
    traffic, _ = two_builds(1)
    context = Context(options=Options(telemetry_header=16))
    with closing(open_file(write(tmp_path / "x.pcap", traffic))) as source:
        batch = concatenate(list(source.batches()))
    assert not ColumnDecoder(context).decode(batch).headers.any()
    assert context.notes == []


@pytest.mark.parametrize(
    "more", [{"extended_header": False}, {"telemetry_header": 12}, {"msg_id_version": 3}]
)
def test_msg_ids_of_version_2_need_the_extended_header(more):
    with pytest.raises(ConfigError, match="MsgIds of version"):
        Options(**{"msg_id_version": 2, **more})


def with_time(item, time, later_ns):
    """Return a datagram with the mission time of its telemetry in another form, and so much later."""
    data = item.payload
    if item.destination[1] != 1235 or len(data) < 16 or data[0] & 0x10:
        return item
    values = cfe.TELEMETRY.parse(data, 6)
    since_epoch = cfe.MissionTime().ns(values["seconds"], values["subseconds"]) + later_ns
    words = replace(time, epoch_s=0).words(since_epoch)
    return replace(item, payload=data[:6] + time.layout(cfe.TELEMETRY).emit(words)[:6] + data[12:])


@pytest.mark.quick("detected-c1_*", "told-c1_*little, 1/10000 s*")
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a_rover.pcap", "little"),
        ("c1_tlm_rate_limit4.pcap.gz", "1/1000 s"),
        ("a_rover.pcap", "since 1980-01-06T00:00:00"),
        ("c1_tlm_rate_limit4.pcap.gz", "1/100 s, since 1979-12-31T23:59:42"),  # of GPS: 18 leap seconds less
        ("c1_tlm_rate_limit4.pcap.gz", "little, 1/10000 s, since 2000-01-01T12:00:00"),
    ],
)
@pytest.mark.parametrize("told", [False, True], ids=["detected", "told"])
def test_mission_time_of_a_real_capture_in_another_form(tmp_path, name, text, told):
    """It is detected where nobody tells it, and every command reads the times that it had before."""
    time, traffic = cfe.MissionTime.of_text(text), datagrams(CAPTURES / name)
    later_ns = 0
    if time.epoch_s is not None:  # as of a flight computer whose clock is right
        sent = next(item for item in traffic if with_time(item, time, 0) is not item)
        words = cfe.TELEMETRY.parse(sent.payload, 6)
        now = cfe.MissionTime().ns(words["seconds"], words["subseconds"])
        later_ns = sent.time_ns - time.epoch_s * SECOND - now
    write(tmp_path / "x.pcap", [with_time(item, time, later_ns) for item in traffic])
    options = Options(time=text if told else None)
    found = []
    for path, options_ in ((CAPTURES / name, Options()), (tmp_path / "x.pcap", options)):
        bench = Settings([ROVER], options=options_).workbench()
        with closing(open_file(path)) as source:
            batch = concatenate(list(source.batches()))
        columns, context = bench.columns.decode(batch), bench.columns.context
        found.append(columns.mission_time_ns)
        rows = ColumnRows(context, 0, batch, columns)
        mask = Where("mission_time >= 0 && cfe_telemetry.seconds > 0", context).mask(batch, columns)
        for row in np.flatnonzero(columns.mission_time_ns > 0)[:40].tolist():
            values = Dissector(context).dissect(batch[row]).layer("cfe_telemetry").values()
            assert context.time.ns(values["seconds"], values["subseconds"]) == columns.mission_time_ns[row]
            assert mask[row]
        assert json.loads(PacketTexts(context).of(rows)[-1])
    assert context.time == time
    assert len([line for line in context.notes if "mission time" in line]) == (not told)
    timed = found[0] > 0
    assert (timed == (found[1] > 0)).all()
    error = found[1][timed] - found[0][timed] - later_ns
    assert np.abs(error).max() <= SECOND // min(time.ticks or 65536, 65536) + SECOND // 65536


@pytest.mark.parametrize("name", ["c3_mqueue10", "d3_cpu1_cpu2", "n3_cfs_restart", "n10_uplink_loss"])
def test_usual_mission_time_is_not_taken_for_another(name):
    report = routes(ROOT / f"tests/captures/{name}.pcap.zst")
    assert [line for line in report.notes if "mission time" in line] == []
