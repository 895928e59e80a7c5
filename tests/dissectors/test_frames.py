"""Transfer frames and F Prime in Wireshark: every field of every frame as our own decoder reads it."""

import random

import pytest
from effort import every, examples
from fprime_frames import BAD, EVENT, PACKETS, any_frames
from fprime_session import CAPTURE, DICTIONARY, own, space, tc, tm
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import ROOT
from rewriting import Udp, write
from rewriting import datagrams as captured
from streams import segments_of, write_segments
from transfer_frames import CRAFT, Maker

from edoras_tools.addons.frames.link import FRAMES
from edoras_tools.decode import Options

ROVER_CAPTURE = ROOT / "samples/captures/a_rover.pcap"
MISSION = ROOT / "samples/missions/rover_ground.yaml"


def test_the_sample_of_f_prime(agreed):
    for structs in every(2, ((DICTIONARY,), ())):
        _, compared, ours, _ = agreed(CAPTURE, structs=structs)
        assert compared > 100
        assert sum(len(packet.messages) for packets in ours.values() for packet in packets) == (
            21 if structs else 0
        )


def test_frames_of_f_prime_that_are_not_right(agreed, tmp_path):
    frames = [frame for frame, *_ in BAD.values()]
    frames += [frame[:size] for frame in frames[:6] for size in range(0, len(frame), 3)]
    frames += [tm(space(PACKETS[1])), own(EVENT), tc(space(EVENT))]
    items = [Udp(10**18 + index, CRAFT, ("127.0.0.1", 50001), one) for index, one in enumerate(frames)]
    path = write(tmp_path / "bad.pcap", items)
    _, _, ours, _ = agreed(path, structs=(DICTIONARY,))
    found = {finding for packets in ours.values() for item in packets for finding in item.findings.labels}
    assert {"checksum_bad", "length_mismatch", "truncated", "struct_length", "unknown_msg_id"} <= found


@pytest.mark.long
@settings(max_examples=examples(20, 20, 1), phases=[Phase.explicit, Phase.generate])
@given(st.lists(any_frames(), min_size=60, max_size=90))
def test_any_frames_of_f_prime(agreed, tmp_path_factory, frames):
    path = tmp_path_factory.mktemp("any") / "any.pcap"
    write(path, [Udp(10**18 + at, CRAFT, ("127.0.0.1", 50000), one) for at, one in enumerate(frames)])
    agreed(path, structs=(DICTIONARY,))


GDS, ROVER = ("10.0.0.1", 50000), ("10.0.0.2", 40000)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["own", "ccsds"])
def test_f_prime_over_tcp(kind, agreed, tmp_path):
    """In both directions, cut anywhere, with what keeps the connection alive between frames."""
    if kind == "own":
        frames = [(packet[:2] == b"\0\0", own(packet)) for packet in PACKETS]
    else:
        frames = [(item.destination[1] == 50000, item.payload) for item in captured(CAPTURE)]
    segments = []
    for up in (True, False):
        stream = b"".join(b"sitting well" + frame for way, frame in frames if way == up)
        ends = (GDS, ROVER) if up else (ROVER, GDS)
        segments += segments_of(stream, range(7, 9000, 611), source=ends[0], destination=ends[1])
    path = tmp_path / "tcp.pcap"
    write_segments(path, segments)
    _, compared, ours, _ = agreed(path, structs=(DICTIONARY,))
    assert compared > 50
    assert sum(bool(packet.layers) for packets in ours.values() for packet in packets) == len(frames)


FORMATS = (
    Maker("tm", 200, second=b"ab", ocf=True),
    Maker("tm", 61, fecf=False, count=250),
    Maker("tm", 1000, channel=7),
    Maker("aos", 90, insert=b"zone", craft=0x2A7, ocf=True),
    Maker("aos", 300, fecf=False, count=0xFFFFF0),
    Maker("tc", 50, segments=True, fecf=False),
    Maker("tc", 400, segments=True, count=200),
    Maker("tc", 999),
)
TELEMETRY = [item.payload for item in captured(ROVER_CAPTURE) if item.destination[1] == 1235]


def mission(tmp_path, **more):
    """Write a mission whose frames of each format have a port of their own, from 6001 on."""
    lines = ["link:", "  ros__parameters:", "    frames:"]
    for number, maker in enumerate(FORMATS, 1):
        told = {"port": 6000 + number, **maker.format(), "link": "to", **more}
        pairs = ", ".join(f"{name}: {str(value).lower()}" for name, value in told.items())
        lines.append(f"      f{number}: {{{pairs}}}")
    (tmp_path / "frames.yaml").write_text("\n".join(lines) + "\n")
    return tmp_path / "frames.yaml"


def disturbed(frames, chance):
    """Return frames of which some are lost, come twice, late or damaged, or are something else."""
    found = []
    for sound in frames:
        frame, what = sound, chance.choice(["", "", "", "", "lost", "twice", "late", "bad", "other", "cut"])
        if what == "lost":
            continue
        if what == "bad":
            place = chance.randrange(len(frame))
            frame = frame[:place] + bytes([frame[place] ^ 1 << chance.randrange(8)]) + frame[place + 1 :]
        if what == "other":
            found.append(chance.randbytes(chance.randrange(1, 30)))
        found.insert(len(found) - 1 if what == "late" else len(found), frame[: -1 if what == "cut" else None])
        if what == "twice":
            found.append(frame)
    return found


@settings(max_examples=examples(20, 20, 1), phases=[Phase.explicit, Phase.generate])
@given(st.randoms(use_true_random=False))
def test_frames_and_their_packets(agreed, tmp_path_factory, chance):
    folder = tmp_path_factory.mktemp("frames")
    items = []
    for number, maker in enumerate(FORMATS, 1):
        first = chance.randrange(len(TELEMETRY) - 40)
        made = replace(maker).carry(TELEMETRY[first : first + 40])
        frames = disturbed([frame for frame, _ in made], chance)
        items += [Udp(0, CRAFT, ("10.0.0.1", 6000 + number), frame) for frame in frames]
    order = sorted(range(len(items)), key=lambda at: (at % 97, at))
    items = [replace(items[at], time_ns=10**18 + place * 10**6) for place, at in enumerate(order)]
    path = write(folder / "frames.pcap", items)
    bench, compared, ours, _ = agreed(path, mission(folder), MISSION)
    assert compared > 3 * len(items)
    assert {item.kind for item in bench.unwrappers[FRAMES].channels} == {"tm", "aos", "tc"}
    inside = [packet for packets in ours.values() for packet in packets[1:]]
    assert sum(packet.message is not None for packet in inside) > 0


@pytest.mark.long
def test_lost_frames_are_marked(agreed, tmp_path):
    items, uncounted = [], [packet[:2] + bytes(2) + packet[4:] for packet in TELEMETRY[:120]]
    for number, maker in list(enumerate(FORMATS, 1))[:6:2]:
        frames = [frame for frame, _ in replace(maker).carry(uncounted)]
        kept = [frame for at, frame in enumerate(frames) if at not in {3, 4, 7}]
        items += [Udp(0, CRAFT, ("10.0.0.1", 6000 + number), frame) for frame in kept]
    items = [replace(item, time_ns=10**18 + at * 10**6) for at, item in enumerate(items)]
    bench, _, _, gaps = agreed(write(tmp_path / "l.pcap", items), mission(tmp_path), MISSION)
    assert gaps == [2, 1] * 3
    assert [channel.lost for channel in bench.unwrappers[FRAMES].channels] == [3] * 3


@pytest.mark.long
@pytest.mark.parametrize("link", ["to", "fprime"])
def test_frames_over_tcp(link, agreed, tmp_path):
    """Each format on a connection of its own, cut anywhere; F Prime has no secondary headers."""
    packets = TELEMETRY[:30] if link == "to" else [space(packet, at) for at, packet in enumerate(PACKETS)]
    segments = []
    for number, maker in list(enumerate(FORMATS, 1))[link == "fprime" :]:
        stream = b"".join(frame for frame, _ in replace(maker).carry(packets))
        ends = CRAFT, ("10.0.0.1", 6000 + number)
        cuts = range(50 + number, len(stream), 333)
        segments += segments_of(stream, cuts, source=ends[0], destination=ends[1])
    path, structs = tmp_path / "tcp.pcap", (DICTIONARY,)
    write_segments(path, segments)
    config = mission(tmp_path, transport="tcp", link=link)
    bench, compared, _, gaps = agreed(path, config, MISSION, structs=structs)
    assert compared > 500
    assert not gaps
    assert [item.packets for item in bench.unwrappers[FRAMES].channels] == [len(packets)] * len(
        bench.unwrappers[FRAMES].channels
    )


COUNTS = {
    "tm": "frames.tm_frame.master_channel_frame_count",
    "aos": "frames.aos_frame.virtual_channel_frame_count",
    "tc": "frames.tc_frame.frame_sequence_number",
}


@pytest.mark.quick("2")
@pytest.mark.parametrize("seed", range(3))
def test_a_connection_whose_capture_begins_inside_a_frame(seed, tshark, tmp_path):
    """Every frame that is whole behind is shown, with a check or without."""
    chance, segments, expected = random.Random(seed), [], {}
    for number, maker in enumerate(FORMATS, 1):
        if maker.kind == "tc" and not maker.fecf:
            continue  # with bypass their counts stand still, so that nothing tells that one follows another
        frames = [frame for frame, _ in replace(maker).carry(TELEMETRY[:40])]
        stream, first = b"".join(frames), chance.randrange(1, len(frames[0]))
        cuts = chance.sample(range(1, len(stream) - first), min(20, len(stream) // 40))
        ends = CRAFT, ("10.0.0.1", 6000 + number)
        _syn, *some = segments_of(stream[first:], cuts, source=ends[0], destination=ends[1])
        segments += some
        expected[6000 + number] = len(frames) - 1
    write_segments(tmp_path / "tcp.pcap", segments)
    asked = [word for name in ("tcp.dstport", *COUNTS.values()) for word in ("-e", name)]
    how = ["-T", "fields", "-E", "occurrence=a", "-E", "aggregator=,"]
    shown = tshark(mission(tmp_path, transport="tcp", link="to"), MISSION)
    lines = shown.run("-r", tmp_path / "tcp.pcap", *how, *asked).decode().splitlines()
    found = dict.fromkeys(expected, 0)
    for line in lines:
        port, *counts = line.split("\t")
        found[int(port)] += sum(bool(item) for column in counts for item in column.split(","))
    assert found == expected


@pytest.mark.quick("ccsds-1")
@pytest.mark.parametrize("first", [1, 5, 20, 33])
@pytest.mark.parametrize("kind", ["own", "ccsds"])
def test_a_connection_of_f_prime_whose_capture_begins_inside_a_frame(kind, first, tshark, tmp_path):
    down = [own(packet) for packet in PACKETS]
    if kind == "ccsds":
        down = [item.payload for item in captured(CAPTURE) if item.destination[1] != 50000]
    stream = b"".join(down)
    first = min(first, len(down[0]) - 1)
    _syn, *segments = segments_of(stream[first:], range(90, 9000, 211), source=ROVER, destination=GDS)
    write_segments(tmp_path / "tcp.pcap", segments)
    name = "fprime.start_word" if kind == "own" else "fprime.tm.master_channel_frame_count"
    how = ["-T", "fields", "-E", "occurrence=a", "-E", "aggregator=,", "-e", name]
    told = tshark(structs=(DICTIONARY,)).run("-r", tmp_path / "tcp.pcap", *how).decode()
    assert len([item for item in told.replace(",", "\n").splitlines() if item]) == len(down) - 1


@pytest.mark.long
def test_frames_that_the_capture_cut(agreed, write_pcap, tmp_path):
    frames = [
        (40000, 6000 + at, frame)
        for at, maker in enumerate(FORMATS, 1)
        for frame, _ in replace(maker).carry(TELEMETRY[:4])
    ]
    frames += [(40000, 50000, item.payload) for item in captured(CAPTURE)]
    frames += [(40000, 50000, own(packet)) for packet in PACKETS]
    snaps = (29, 32, 34, 35, 36, 40, 60, 100, 65535)
    path = write_pcap(tmp_path / "cut.pcap", frames, snaps=snaps)
    agreed(path, mission(tmp_path), MISSION, structs=(DICTIONARY,))


@pytest.mark.long
def test_a_port_alone_makes_no_frames(tshark, write_pcap, tmp_path):
    """What frames are like is for a mission to say: with a port they stay data; no preference names one."""
    frames = [frame for frame, _ in replace(FORMATS[0]).carry(TELEMETRY[:3])]
    path = write_pcap(tmp_path / "port.pcap", [(40000, 7777, item) for item in frames])
    program = tshark(options=Options(ports=((FRAMES, 7777),)))
    found = program.frames(path)
    assert len(found) == len(frames)
    assert not any(frame.fields for frame in found.values())
    with pytest.raises(AssertionError, match="frames_ports"):
        program.frames(path, "-o", "edoras.frames_ports:7777")
