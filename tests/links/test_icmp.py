"""ICMP errors that quote a datagram: found, read, filtered and summed up as tshark does, on any bytes."""

import struct
import subprocess

import numpy as np
import pytest
from field_filters import compared
from hypothesis import given
from hypothesis import strategies as st
from icmp_errors import datagram, error_about, frame
from mutations import Frame, write

from edoras_tools.decode import ColumnDecoder, Context, Dissector
from edoras_tools.decode.filters.filter import Where
from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.io.formats.open import open_file
from edoras_tools.io.frames.frame_batch import FrameBatch
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.io.frames.network import quoted_ports
from edoras_tools.links.icmp import FORMS, ICMP
from edoras_tools.model import OTHER, Endpoint, Finding, Peer
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire import cfe, sbn

ROVER, CFS, FAR = ("10.0.0.4", 8585), ("10.0.0.2", 8080), "10.0.0.1"
ROVER_6, CFS_6 = ("fd00::4", 1235), ("fd00::2", 40000)
TWIST = struct.pack("<6d", 0.5, 0, 0, 0, 0, -0.2)
COMMAND = cfe.emit_command(0x1827, 1, bytes(20))
TELEMETRY = cfe.emit_telemetry(0x0803, bytes(28))
SUB = sbn.emit(sbn.MsgType.SUB, Peer(66, 1), sbn.emit_subscriptions([sbn.Subscription(0x82A)]))
LONG = TELEMETRY + bytes(900)


def at(port, host="10.0.0.9"):
    return host, port


ERRORS = {
    "robot": (
        error_about(datagram(TWIST, CFS, ROVER, id=77)),
        "port unreachable: 10.0.0.4:8585 did not get ROBOT linear_x=0.5 angular_z=-0.2",
    ),
    "IPv6": (
        error_about(datagram(TELEMETRY, CFS_6, ROVER_6)),
        "port unreachable: [fd00::4]:1235 did not get TO 0x0803 SB_HK",
    ),
    "by a router": (
        error_about(datagram(COMMAND, CFS, at(1234)), code=1, reporter=FAR),
        "host unreachable: 10.0.0.9:1234 did not get CI 0x1827",
    ),
    "firewall": (
        error_about(datagram(COMMAND, CFS_6, at(1234, "fd00::9")), code=1, reporter="fd00::1"),
        "communication prohibited: [fd00::9]:1234 did not get CI 0x1827",
    ),
    "too long": (
        error_about(datagram(LONG, at(5), at(1235)), code=4, reporter=FAR),
        "fragmentation needed: 10.0.0.9:1235 did not get TO 0x0803 SB_HK",
    ),
    "a hop too many": (
        error_about(datagram(COMMAND, CFS, at(1234)), kind=11, code=0, reporter=FAR),
        "hop limit exceeded: 10.0.0.9:1234 did not get CI 0x1827",
    ),
    "without its later fragments": (
        error_about(datagram(LONG, at(5), at(1235), flags="MF"), kind=11, code=1),
        "fragment reassembly time exceeded: 10.0.0.9:1235 did not get TO 0x0803 SB_HK",
    ),
    "too long in IPv6": (
        error_about(datagram(COMMAND, CFS_6, at(1234, "fd00::9")), kind=2, code=0, reporter="fd00::1"),
        "packet too big: [fd00::9]:1234 did not get CI 0x1827",
    ),
    "only the first 8 bytes": (
        error_about(datagram(COMMAND, CFS, at(1234)), most=28),
        f"port unreachable: 10.0.0.9:1234 did not get CI {len(COMMAND)} bytes",
    ),
    "subscription": (
        error_about(datagram(SUB, at(2234), at(2235))),
        "port unreachable: 10.0.0.9:2235 did not get SBN 0x082a from 66:1",
    ),
    "of no link": (
        error_about(datagram(b"x" * 60, CFS, at(53))),
        "port unreachable: 10.0.0.9:53 did not get 60 bytes",
    ),
}
NO_ERROR = {
    "echo": error_about(datagram(TWIST, CFS, ROVER)).copy(),
    "about TCP": error_about(datagram(TWIST, CFS, ROVER, proto=6)),
    "about a later fragment": error_about(datagram(TWIST, CFS, ROVER, frag=20)),
    "about IP options": error_about(datagram(TWIST, CFS, ROVER, options=b"\1\1\1\0")),
    "without the UDP header": error_about(datagram(TWIST, CFS, ROVER), most=27),
    "about TCP in IPv6": error_about(datagram(TWIST, CFS_6, ROVER_6, nh=6)),
    "IPv4 in IPv6": error_about(datagram(TWIST, CFS_6, ROVER_6, version=4)),
    "a fragment itself": error_about(datagram(TWIST, CFS, ROVER)).copy(),
}
NO_ERROR["echo"].payload.type = 8
NO_ERROR["a fragment itself"].frag = 3


def batch_of(frames, cut=None):
    """Read frames as a source does, of each at most ``cut`` bytes."""
    kept = [item[:cut] for item in frames]
    lengths = np.array([len(item) for item in kept], np.int32)
    return FrameBatch(
        data=np.frombuffer(b"".join(kept), np.uint8),
        number=np.arange(1, len(frames) + 1),
        time_ns=np.arange(len(frames)) * 1000,
        link_type=np.ones(len(frames), np.uint16),
        offset=np.cumsum(lengths, dtype=np.int64) - lengths,
        length=lengths,
        original_length=np.array([len(item) for item in frames], np.int32),
    )


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_is_a_row_of_its_own(name):
    packet, summary = ERRORS[name]
    whole, demux, context = frame(packet), Demux(), Context()
    batch = demux.demux(batch_of([whole]))
    assert (len(batch), demux.skipped) == (1, 0)
    (one,) = batch
    assert (one.frame, one.payload) == (whole, bytes(packet.payload))
    assert (one.source, one.destination) == (Endpoint(packet.src, 0), Endpoint(packet.dst, 0))
    columns = ColumnDecoder(context).decode(batch)
    decoded = Dissector(context).dissect(one)
    assert columns.link[0] == decoded.link == ICMP
    assert decoded.summary == summary
    assert (columns.msg_id[0], columns.packet_offset[0], columns.findings[0]) == (-1, -1, 0)
    form = FORMS[":" in packet.src]
    headers = form.kinds[one.payload[0]], *form.quoted
    assert [layer.name for layer in decoded.layers] == [item.name for item in headers]
    quoted = ICMP.quoted(one)
    told = decoded.layers[-1].values()
    assert [quoted.source.port, quoted.destination.port] == [told["source_port"], told["destination_port"]]
    assert quoted_ports(batch, np.array([0])).tolist() == [[quoted.source.port, quoted.destination.port]]


def test_what_is_quoted_is_the_datagram_as_far_as_it_goes():
    (short, long) = Demux().demux(batch_of([frame(ERRORS[name][0]) for name in ("robot", "too long")]))
    whole, part = ICMP.quoted(short), ICMP.quoted(long)
    assert (whole.payload, whole.original_length, whole.findings) == (TWIST, len(TWIST), Finding(0))
    assert (part.payload, part.original_length) == (LONG[: 548 - 28], len(LONG))
    assert part.findings == Finding.CAPTURE_CUT


@pytest.mark.parametrize("name", NO_ERROR)
def test_what_quotes_no_datagram_is_skipped_and_counted(name):
    demux = Demux()
    assert len(demux.demux(batch_of([frame(NO_ERROR[name])]))) == 0
    assert demux.skipped == 1


@pytest.mark.each(2)
@pytest.mark.parametrize("name", ["robot", "IPv6"])
def test_an_error_that_the_capture_cut(name):
    whole = frame(ERRORS[name][0])
    form = FORMS[name == "IPv6"]
    ip = {4: 20, 6: 40}[form.version]
    for kept in range(len(whole)):
        batch = Demux().demux(batch_of([whole], kept))
        enough = kept >= 14 + ip + form.size
        assert len(batch) == enough
        if enough:
            (one,) = batch
            assert one.findings == Finding.CAPTURE_CUT
            assert "did not get" in Dissector(Context()).dissect(one).summary


def test_errors_stand_in_the_order_of_the_frames():
    plain = [frame(datagram(TELEMETRY, at(number), at(1235))) for number in range(1, 4)]
    errors = [frame(ERRORS[name][0]) for name in ("IPv6", "robot", "firewall")]
    tcp = frame(NO_ERROR["about TCP"].payload.payload)
    six = frame(datagram(TELEMETRY, CFS_6, ROVER_6))
    frames = [plain[0], errors[0], errors[1], plain[1], tcp, errors[2], six, plain[2]]
    demux = Demux()
    batch = demux.demux(batch_of(frames))
    assert batch.number.tolist() == [1, 2, 3, 4, 6, 7, 8]
    assert demux.skipped == 1
    assert [one.frame for one in batch] == [frames[at - 1] for at in batch.number.tolist()]
    ends = [one.source.address for one in batch]
    assert ends == ["10.0.0.9", "fd00::4", "10.0.0.4", "10.0.0.9", "fd00::1", "fd00::2", "10.0.0.9"]


def test_a_datagram_to_port_0_is_no_error_unless_it_reads_as_one():
    (one,) = Demux().demux(batch_of([frame(datagram(TELEMETRY, at(0), at(0)))]))
    assert Dissector(Context()).dissect(one).link is not ICMP


def test_who_sends_is_not_learnt_from_quotes():
    """The first identity of an SBN endpoint is its own; one in a quote, which may be garbled, is none."""
    other = sbn.emit(sbn.MsgType.SUB, Peer(66, 9), sbn.emit_subscriptions([sbn.Subscription(0x82A)]))
    frames = [
        frame(error_about(datagram(other, at(2234), at(2235)))),
        frame(datagram(SUB, at(2234), at(2235))),
    ]
    batch, context = Demux().demux(batch_of(frames)), Context()
    error, own = (Dissector(context).dissect(one) for one in batch)
    assert error.link == ICMP
    assert Finding.SBN_ID_MISMATCH not in own.findings
    assert not ColumnDecoder(Context()).decode(batch).findings[1] & Finding.SBN_ID_MISMATCH


def test_filters_find_the_fields_that_the_tree_has():
    bench = Settings().workbench()
    batch = Demux().demux(batch_of([frame(packet) for packet, _ in ERRORS.values()]))
    rows = ColumnRows(bench.columns.context, 0, batch, bench.columns.decode(batch))
    assert compared(bench, rows, ICMP.layouts) > 12 * len(ERRORS)
    chosen = Where("quoted_ipv4.destination == 0a000004", bench.columns.context).passing(rows)
    assert np.flatnonzero(chosen).tolist() == [list(ERRORS).index("robot")]


TSHARK = {
    "icmp.type": ("icmp", "type"),
    "icmp.code": ("icmp", "code"),
    "icmpv6.type": ("icmpv6", "type"),
    "icmpv6.code": ("icmpv6", "code"),
    "udp.srcport": ("quoted_udp", "source_port"),
    "udp.dstport": ("quoted_udp", "destination_port"),
    "udp.length": ("quoted_udp", "length"),
    "ip.id": ("quoted_ipv4", "identification"),
    "ip.dst": ("quoted_ipv4", "destination"),
    "ipv6.dst": ("quoted_ipv6", "destination"),
    "ipv6.plen": ("quoted_ipv6", "payload_length"),
    "ip.ttl": ("quoted_ipv4", "time_to_live"),
}
"""What tshark calls our fields; of IP it shows the outer header first."""


def test_tshark_reads_the_same(tmp_path):
    frames = [frame(packet) for packet, _ in ERRORS.values()]
    path = write(tmp_path / "x.pcap", [Frame(at * 1000, item, len(item)) for at, item in enumerate(frames)])
    fields = [part for name in TSHARK for part in ("-e", name)]
    run = subprocess.run(
        ["tshark", "-n", "-r", path, "-T", "fields", *fields],
        capture_output=True,
        check=True,
        text=True,
        timeout=300,
    )
    source, context = open_file(path), Context()
    packets = [one for batch in source.batches() for one in batch]
    source.close()
    lines = run.stdout.rstrip("\n").split("\n")
    assert len(lines) == len(packets) == len(ERRORS)
    shown = 0
    for one, line in zip(packets, lines, strict=True):
        layers = Dissector(context).dissect(one).layers
        ours = {(layer.name, field.name): field for layer in layers[1:] for field in layer.fields}
        ours |= {(layers[0].name.partition("_")[0], field.name): field for field in layers[0].fields}
        for place, text in zip(TSHARK.values(), line.split("\t"), strict=True):
            value = text.split(",")[-1]
            if place in ours:
                field = ours[place]
                assert value in {str(field.value), field.text.partition(" ")[0]}, (place, value)
                shown += 1
    assert shown == 8 * 8 + 3 * 7


BYTES = st.binary(max_size=120)


@given(
    st.lists(
        st.tuples(
            st.sampled_from(sorted(ERRORS)),
            st.lists(st.tuples(st.integers(14, 110), st.integers(0, 255)), max_size=4),
            st.integers(14, 700),
        ),
        min_size=1,
        max_size=6,
    )
)
def test_garbled_errors_are_read_or_skipped_and_both_readers_agree(changes):
    frames = []
    for name, places, length in changes:
        octets = bytearray(frame(ERRORS[name][0]))
        for place, value in places:
            if place < len(octets):
                octets[place] = value
        frames.append(bytes(octets[:length]))
    demux, context = Demux(), Context()
    batch = demux.demux(batch_of(frames))
    assert len(batch) + demux.skipped == len(frames)
    columns = ColumnDecoder(context).decode(batch)
    for row, one in enumerate(batch):
        decoded = Dissector(context).dissect(one)
        assert decoded.link == columns.link[row]
        assert int(decoded.findings) == columns.findings[row]
        if decoded.link == ICMP:
            assert decoded.stop is None
            assert one.payload[8] >> 4 in {form.version for form in FORMS if one.payload[0] in form.kinds}
            assert " did not get " in decoded.summary


@given(BYTES)
def test_any_bytes_from_port_0(payload):
    (one,) = Demux().demux(batch_of([frame(datagram(payload, at(0), at(0)))]))
    decoded = Dissector(Context()).dissect(one)
    assert decoded.link == OTHER or decoded.link.transport.ports == (0,)
