"""Packets are framed anew: other readers of frames find every packet again, and the channel's own counts."""

import struct

import pytest
import yaml
from places import SAMPLES
from rewriting import Udp, datagrams, write
from spacepackets.ccsds.tm_frame import TmTransferFrame
from transfer_frames import CRAFT, GROUND, Maker, batch_of, packets_of, space_packet
from waiting import Ear

from edoras_tools.addons.frames.sending import header_check
from edoras_tools.addons.frames.unframer import Unframer
from edoras_tools.wire.transfer_frames import FrameFormat

ROVER = SAMPLES / "captures/a_rover.pcap"
FORMS = {
    "tm": {"kind": "tm", "length": 128},
    "tm_whole": {"kind": "tm", "length": 1115, "fecf": False},
    "tm_ocf": {"kind": "tm", "length": 128, "ocf": True},
    "aos": {"kind": "aos", "length": 200, "ocf": True, "insert_zone": 4},
    "tc": {"kind": "tc"},
    "tc_segments": {"kind": "tc", "segment_header": True},
}


@pytest.fixture
def sent(tmp_path, call):
    """A function: the frames that replay sends of the rover, or of another capture, by a mission's form."""

    def send(form, capture=ROVER):
        mission = tmp_path / "frames.yaml"
        with Ear() as ear:
            entry = {"port": ear.port, **form}
            node = {"ros__parameters": {"frames": {"f": entry}}}
            mission.write_text(yaml.safe_dump({"ground_bridge_node": node}))
            to = "frames:up" if form["kind"] == "tc" else "frames"
            target = f"127.0.0.1:{ear.port}"
            words = ("--to", to, "-c", mission, "--target", target, "--max", "-q")
            done = call("replay", capture, *words)
            assert done.code == 0, done.err
            return ear.take()

    return send


def packets_to(port):
    return [item.payload for item in datagrams(ROVER) if item.destination[1] == port]


def packets_in(zones):
    """Return the packets of (data, first header pointer), put together as the pointers and lengths say."""
    stream, found, at = b"".join(data for data, _ in zones), [], 0
    begins, place = [], 0
    for data, first in zones:
        begins += [place + first] if first != 0x7FF else []
        place += len(data)
    heads = []
    while at + 6 <= len(stream):
        word, _, length = struct.unpack_from(">HHH", stream, at)
        heads.append(at)
        if word & 0x7FF != 0x7FF:
            found.append(stream[at : at + length + 7])
        at += length + 7
    assert set(begins) <= {*heads, at}
    return found


@pytest.mark.parametrize("kind", ["tm", "tm_whole", "tm_ocf"])
def test_tm_frames_as_spacepackets_reads_them(kind, sent):
    form = FORMS[kind]
    frames = [TmTransferFrame.unpack(item, form["length"], form.get("fecf", True)) for item in sent(form)]
    heads = [item.primary_header for item in frames]
    firsts = [item.frame_datafield_status.first_header_pointer for item in heads]
    zones = [(bytes(item.data_field), first) for item, first in zip(frames, firsts, strict=True)]
    assert packets_in(zones) == packets_to(1235)
    assert [item.vc_frame_count for item in heads] == [at % 256 for at in range(len(frames))]
    assert [item.master_ch_frame_count for item in heads] == [at % 256 for at in range(len(frames))]
    assert {item.op_ctrl_field for item in frames} == {bytes(4) if form.get("ocf") else None}


def test_aos_frames_byte_by_byte(sent):
    frames = sent(FORMS["aos"])
    assert {len(item) for item in frames} == {200}
    assert [int.from_bytes(item[2:5], "big") for item in frames] == [*range(len(frames))]
    assert {item[0] >> 6 for item in frames} == {1}
    zones = [(item[12:-6], int.from_bytes(item[10:12], "big") & 0x7FF) for item in frames]
    assert packets_in(zones) == packets_to(1235)


@pytest.mark.parametrize("kind", ["tc", "tc_segments"])
def test_tc_frames_byte_by_byte(kind, sent):
    frames, head = sent(FORMS[kind]), 5 + (kind == "tc_segments")
    assert [item[head:-2] for item in frames] == packets_to(1234)
    assert [int.from_bytes(item[2:4], "big") & 0x3FF for item in frames] == [len(item) - 1 for item in frames]
    assert [item[4] for item in frames] == [at % 256 for at in range(len(frames))]
    assert kind == "tc" or {item[5] for item in frames} == {3 << 6}


@pytest.mark.parametrize("kind", ["tm", "aos", "tc"])
def test_a_packet_goes_in_the_virtual_channel_in_which_it_was_recorded(kind, sent, tmp_path):
    """Two channels of one spacecraft and one of another, in turns; every count is the channel's own."""
    makers = [Maker(kind, 100, channel=channel, craft=craft) for channel, craft in ((1, 42), (3, 42), (1, 7))]
    apid, packets, items = 0x1027 if kind == "tc" else 0x27, {}, []
    for number in range(30):
        maker = makers[number % 3]
        packet = space_packet(apid, bytes([number]) * 60, number)
        packets.setdefault((maker.craft, maker.channel), []).append(packet)
        items += [Udp(number * 10**9, CRAFT, GROUND, frame) for frame, _ in maker.carry([packet])]
    form = makers[0].format() | {"port": GROUND[1]}
    frames = sent(form, capture=write(tmp_path / "channels.pcap", items))
    reader = Unframer({GROUND[1]: FrameFormat(**makers[0].format())})
    found = {}
    reader.take(batch_of(frames))
    for number, frame in enumerate(frames):
        single = Unframer({GROUND[1]: FrameFormat(**makers[0].format())})
        inside = packets_of(single.take(batch_of([frame], number + 1)))
        channel = single.channels[0]
        found.setdefault((channel.spacecraft_id, channel.virtual_channel_id), []).extend(
            packet for packet, _ in inside
        )
    assert found == packets
    assert [(item.frames, item.lost) for item in reader.channels] == [(10, 0)] * 3
    assert [(item.frames, item.lost) for item in reader.masters] == [(20, 0), (10, 0)] * (kind == "tm")


def test_without_a_mission_it_is_said(call):
    done = call("replay", ROVER, "--to", "frames")
    assert (done.code, len(done.err)) == (2, 1)
    assert "no mission file says where TM or AOS frames go" in done.err[0]


def test_a_made_up_command_is_framed_with_the_channels_own_counts(call, tmp_path):
    """The packets are those that ``inject`` sends to Command Ingest."""
    mission = yaml.safe_load((SAMPLES / "missions/rover_ground.yaml").read_text())
    path = tmp_path / "frames.yaml"
    with Ear() as ear, Ear() as plain:
        next(iter(mission.values()))["ros__parameters"]["frames"] = {"up": {"port": ear.port, "kind": "tc"}}
        path.write_text(yaml.safe_dump(mission))
        words = ("inject", "/cmd_vel", "{linear: {x: 0.5}}", "-c", path, "-n", "3", "--rate", "50", "-q")
        for to, target in (("frames:up", ear), ("ci", plain)):
            done = call(*words, "--to", to, "--target", f"127.0.0.1:{target.port}", "--no-listen")
            assert done.code == 0, done.err
        frames, packets = ear.take(), plain.take()
    assert [item[5:-2] for item in frames] == packets
    assert [item[4] for item in frames] == [0, 1, 2]


def powers():
    """The powers of a root of x^4 + x + 1, as CCSDS 732.0-B lists them."""
    item = 1
    for _ in range(15):
        yield item
        item = item << 1 ^ (0b10011 if item & 8 else 0)


def test_the_header_of_an_aos_frame_has_its_error_control(sent):
    """Each header is a word of the code: it is zero at the roots a^6 to a^9 of the generator."""
    power = [*powers()]
    assert power[6:10] == [0b1100, 0b1011, 0b0101, 0b1010]

    def product(one, other):
        return one and other and power[(power.index(one) + power.index(other)) % 15]

    form = FORMS["aos"] | {"header_error_control": True}
    frames = sent(form)
    assert {len(item) for item in frames} == {200}
    for frame in frames:
        octets = frame[0], frame[1], frame[5], frame[6], frame[7]
        word = [part for octet in octets for part in (octet >> 4, octet & 15)]
        for root in power[6:10]:
            value = 0
            for symbol in word:
                value = product(value, root) ^ symbol
            assert value == 0
    zones = [(item[14:-6], int.from_bytes(item[12:14], "big") & 0x7FF) for item in frames]
    assert packets_in(zones) == packets_to(1235)


def test_an_error_in_a_header_shows():
    head = bytes.fromhex("450100000100")
    words = {header_check(bytes([*head[:at], head[at] ^ 1, *head[at + 1 :]])) for at in (0, 1, 5)}
    assert len(words | {header_check(head)}) == 4
