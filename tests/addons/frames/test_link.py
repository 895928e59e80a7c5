"""Transfer frames as a layer below a link: from a capture to its rows, views, filters and recordings."""

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from effort import examples
from field_filters import compared
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import CAPTURES, ROOT
from rewriting import Udp, datagrams, write
from streams import segments_of, write_segments
from transfer_frames import GROUND, Maker, space_packet

from edoras_tools.addons.frames.link import FRAMES
from edoras_tools.decode import Context
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import TO
from edoras_tools.mission import loads
from edoras_tools.model import Finding
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.wire.transfer_frames import FrameFormat

IN_TCP = "link: {{ros__parameters: {{frames: {{down: {{length: 99, transport: tcp, {}}}}}}}}}"
MAKERS = {
    "tm": Maker("tm", 40, second=b"ab", ocf=True),
    "aos": Maker("aos", 40, insert=b"zone", craft=0x2A7),
    "tc": Maker("tc", 40, segments=True, fecf=False),
}
PACKETS = [space_packet(0x27, bytes([number]) * 60, number) for number in range(8)]


def mission(tmp_path, maker, **more):
    items = {"port": GROUND[1], **maker.format(), **more}
    told = ", ".join(f"{name}: {str(value).lower()}" for name, value in items.items())
    path = tmp_path / "frames.yaml"
    path.write_text(f"link:\n  ros__parameters:\n    frames:\n      telemetry: {{{told}}}\n")
    return path


def captured(tmp_path, maker, lost=()):
    frames = [frame for frame, _ in maker.carry(PACKETS)]
    items = [
        Udp(number * 10**6, ("10.0.0.2", 40000), GROUND, frame)
        for number, frame in enumerate(frames)
        if number not in lost
    ]
    return write(tmp_path / "frames.pcap", items), len(frames)


def rows_of(path, config):
    bench = Settings([config]).workbench()
    with closing(open_file(path)) as source, reading(source, bench) as loop:
        (rows,) = (rows for rows in loop if len(rows))
    return bench, rows


def links_of(path, config, *, filters=False):
    """Return the decoders, and (link, payload) of every row; both readers agree, filters too if asked."""
    bench, found = Settings([config]).workbench(), []
    with closing(open_file(path)) as source, reading(source, bench) as loop:
        for rows in loop:
            for row in range(len(rows.batch)):
                decoded = bench.dissector.dissect(rows.batch[row])
                assert decoded.link == rows.columns.link[row]
                assert int(decoded.findings) == rows.columns.findings[row]
                found.append((decoded.link, rows.batch[row].payload))
            if filters and len(rows):
                compared(bench, rows, FRAMES.layouts)
    return bench, found


@pytest.mark.parametrize("kind", MAKERS)
def test_frames_and_their_packets_are_rows_that_both_readers_agree_on(kind, tmp_path):
    maker = replace(MAKERS[kind])
    path, count = captured(tmp_path, maker)
    bench, rows = rows_of(path, mission(tmp_path, maker, link="to"))
    link, batch = rows.column("link"), rows.batch
    assert (int((link == FRAMES).sum()), int((link == TO).sum())) == (count, len(PACKETS))
    assert [batch[row].payload for row in np.flatnonzero(link == TO)] == PACKETS
    for row in range(len(batch)):
        decoded = bench.dissector.dissect(batch[row])
        assert (decoded.link, int(decoded.findings)) == (link[row], rows.column("findings")[row])
        if decoded.link is FRAMES:
            values = {name: value for layer in decoded.layers for name, value in layer.values().items()}
            assert values["virtual_channel_id"] == maker.channel
            assert decoded.summary.startswith(f"{kind.upper()} frame ")
            assert ("frame_error_control" in values) == maker.fecf
            assert decoded.layers[-1].end == len(batch[row].payload) or not maker.fecf


@settings(max_examples=examples(4))
@given(cuts=st.sets(st.integers(0, 700), max_size=20), server=st.booleans())
@pytest.mark.parametrize("kind", MAKERS)
def test_frames_in_tcp_streams_are_those_of_datagrams(kind, cuts, server):
    """Either end may listen; segments are cut anywhere."""
    maker = replace(MAKERS[kind])
    frames = [frame for frame, _ in maker.carry(PACKETS)]
    ends = {"source": ("10.0.0.2", 40000), "destination": GROUND}
    if server:
        ends = {"source": GROUND, "destination": ("10.0.0.2", 40000)}
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_segments(folder / "t.pcap", segments_of(b"".join(frames), cuts, **ends))
        _, found = links_of(folder / "t.pcap", mission(folder, maker, link="to", transport="tcp"))
    assert [payload for link, payload in found if link is FRAMES] == frames
    assert [payload for link, payload in found if link is TO] == PACKETS


@pytest.mark.parametrize("fecf", [True, False])
def test_a_stream_that_lost_a_segment_goes_on_with_the_next_whole_frame(fecf, tmp_path):
    maker = Maker("tm", 40, fecf=fecf)
    frames = [frame for frame, _ in maker.carry(PACKETS)]
    segments = segments_of(b"".join(frames), range(0, 5000, 70), destination=GROUND)
    write_segments(tmp_path / "t.pcap", segments[:5] + segments[6:])
    config = mission(tmp_path, maker, transport="tcp")
    bench, rows = links_of(tmp_path / "t.pcap", config, filters=True)
    found = [payload for link, payload in rows if link is FRAMES]
    assert len(frames) - 4 <= len(found) < len(frames)
    assert set(found) <= set(frames)
    assert bench.unwrappers[FRAMES].channels[0].lost == len(frames) - len(found)
    assert bench.unwrappers[FRAMES].strange == 0


@pytest.mark.parametrize("kind", MAKERS)
def test_filters_find_the_fields_that_the_tree_has(kind, tmp_path):
    maker = replace(MAKERS[kind])
    path, _ = captured(tmp_path, maker)
    bench, rows = rows_of(path, mission(tmp_path, maker))
    assert compared(bench, rows, FRAMES.layouts)


@pytest.fixture
def rover(tmp_path):
    """A real capture whose telemetry travels in TM frames, of which some are lost; and the packets left."""
    items = datagrams(CAPTURES / "a_rover.pcap")
    telemetry = [item for item in items if item.destination[1] == 1235]
    maker = Maker("tm", 200)
    carried = maker.carry([item.payload for item in telemetry])
    step = (telemetry[-1].time_ns - telemetry[0].time_ns) // len(carried)
    lost = {50, 51, 200}
    frames = [
        Udp(telemetry[0].time_ns + number * step, telemetry[0].source, ("127.0.0.1", GROUND[1]), frame)
        for number, (frame, _) in enumerate(carried)
        if number not in lost
    ]
    others = [item for item in items if item.destination[1] != 1235]
    path = write(tmp_path / "rover.pcap", sorted([*frames, *others], key=lambda item: item.time_ns))
    touched = set().union(*(carried[number][1] for number in lost))
    configs = [mission(tmp_path, maker), ROOT / "samples/missions/rover_ground.yaml"]
    return path, configs, len(frames) + len(others), len(telemetry) - len(touched), lost


def test_a_recording_holds_the_frames_and_gives_the_packets_again(rover, tmp_path):
    path, configs, captured_, packets, lost = rover
    target = tmp_path / "rover.mcap"
    report = record(open_file(path), Settings(configs).workbench(), Target(target))
    assert report.summary()["datagrams"] == captured_
    assert report.ledger.taken_out == packets
    again = tmp_path / "again.pcap"
    source = open_file(target)
    bench = Settings().workbench(source.info)
    told = record(source, bench, Target(again))
    assert again.read_bytes() == path.read_bytes()
    assert told.ledger.routes() == report.ledger.routes()
    assert (told.ledger.taken_out, told.summary()["datagrams"]) == (packets, captured_)
    (line,) = (note for note in told.notes if "frames" in note)
    assert f"{len(lost)} lost, {packets} packets, 2 cut" in line


def test_the_doctor_names_the_lost_frames_and_info_the_damaged(rover):
    path, configs, *_ = rover
    found = examine(open_file(path), Settings(configs).workbench()).diagnosis
    (told,) = (item for item in found.verdicts if item.rule == "frames_lost")
    assert told.reason == (
        "TM channel 1 of spacecraft 0x02a: 3 frames lost of "
        f"{found.capture.unwrappers[FRAMES].channels[0].frames + 3}, packets cut at 2 places"
    )
    assert found.bad
    sound = datagrams(path)
    damaged = [
        item if item.destination[1] != GROUND[1] or number % 40 else _broken(item)
        for number, item in enumerate(sound)
    ]
    wrong = [item for item, old in zip(damaged, sound, strict=True) if item != old]
    report = inspect(open_file(write(path, damaged)), Settings(configs).workbench())
    assert len(wrong) > 2
    assert f"transfer frames: {len(wrong)} damaged (wrong CRC, or a header that does not fit)" in report.notes
    assert report.ledger.findings[Finding.CHECKSUM_BAD.label] == len(wrong)


def _broken(item):
    return Udp(item.time_ns, item.source, item.destination, item.payload[:-1] + bytes([item.payload[-1] ^ 1]))


def test_frames_in_tcp_streams():
    context = Context(loads({"f.yaml": IN_TCP.format("port: 5111, kind: aos").encode()}))
    (framed,) = context.mission.frames
    assert framed.format == FrameFormat("aos", 99, stream=True)
    assert context.framings[5111].form == framed.format
    context = Context(loads({"f.yaml": IN_TCP.format("port: 50000, kind: tm, link: fprime").encode()}))
    assert context.framings[50000].tm_bytes == 99
    assert context.framings[50001].tm_bytes == 1024
