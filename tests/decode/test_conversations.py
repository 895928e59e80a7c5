import random
import struct
from contextlib import closing

import numpy as np
import pytest
from places import CAPTURES
from rewriting import Udp, datagrams, write

from edoras_tools.decode import ColumnDecoder, Context, Options
from edoras_tools.decode.conversations import ConversationKind, Conversations
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.model import Peer
from edoras_tools.wire import cfe, sbn

GROUND, FLIGHT, OTHER = ("10.0.0.2", 40000), ("10.0.0.1", 1234), ("10.9.9.9", 5004)
NOOP = cfe.emit_command(0x1806, 0)
RANDOM = random.Random(7)


def rtp(number):
    return struct.pack(">BBHII", 0x80, 96, number, number * 160, 7) + RANDOM.randbytes(160)


def dns(number):
    return struct.pack(">HHHHHH", RANDOM.randrange(65536), 0x0100, 1, 0, 0, 0) + b"\5robot\0\0\1\0\1"


JUNK = {
    "rtp": rtp,
    "dns": dns,
    "json": lambda number: b'{"x": %d, "name": "robot"}' % number,
    "random": lambda _: RANDOM.randbytes(RANDOM.randrange(1, 200)),
    "empty strings": lambda _: b"\0",
}


def of(path, *parts, options=None):
    """Return the kinds of the conversations of some datagrams, by their ends."""
    items = [
        Udp((number + 1) * 10**7, source, target, payload)
        for number, (source, target, payload) in enumerate(part for some in parts for part in some)
    ]
    conversations = read(write(path, items), options)
    return {(str(flow.source), str(flow.destination)): flow.kind for flow in conversations.judge()}


def read(path, options=None):
    context = Context(options=options)
    decoder, found = ColumnDecoder(context), Conversations(context)
    with closing(open_file(path)) as source:
        for batch in source.batches():
            found.add(batch, decoder.decode(batch))
    return found


def sent(count, payload, source=GROUND, target=FLIGHT):
    return [(source, target, payload(number) if callable(payload) else payload) for number in range(count)]


@pytest.mark.parametrize("count", [1, 3, 300])
@pytest.mark.parametrize("kind", JUNK)
def test_other_programs_on_a_links_port_are_left_out_however_many(tmp_path, kind, count):
    found = of(tmp_path / "x.pcap", sent(count, JUNK[kind], OTHER))
    assert set(found.values()) == {ConversationKind.FOREIGN}


@pytest.mark.parametrize("count", [1, 300])
def test_what_reaches_a_cfs_is_a_strangers(tmp_path, count):
    found = of(tmp_path / "x.pcap", sent(1, NOOP), sent(count, rtp, OTHER))
    assert found == {
        ("10.0.0.2:40000", "10.0.0.1:1234"): ConversationKind.CFS,
        ("10.9.9.9:5004", "10.0.0.1:1234"): ConversationKind.STRANGER,
    }


@pytest.mark.parametrize("count", [1, 100])
def test_malformed_commands_of_the_ground_are_its_own(tmp_path, count):
    # From another socket of the same address, with a MsgId of nobody and a length that is wrong.
    bad = bytes.fromhex("1aaac000ffff0100")
    found = of(tmp_path / "x.pcap", sent(3, NOOP), sent(count, bad, ("10.0.0.2", 50001)))
    assert set(found.values()) == {ConversationKind.CFS}


@pytest.mark.parametrize(
    ("payload", "link"),
    [
        (NOOP, table.link_of_label("ci")),
        (cfe.emit_telemetry(0x0827, bytes(60)), table.link_of_label("to")),
        (sbn.emit(sbn.MsgType.HEARTBEAT, Peer(66, 1)), table.link_of_label("sbn")),
    ],
    ids=["ci", "to", "sbn"],
)
def test_a_link_on_a_port_that_nobody_named_is_told_with_the_option(tmp_path, payload, link):
    target = ("10.0.0.1", 5234)
    items = [Udp(number, GROUND, target, payload) for number in range(1, 4)]
    path = write(tmp_path / "x.pcap", items)
    assert read(path).notes() == [
        (
            f"3 datagrams on port 5234 look like {link.name} traffic and were left out: "
            f"name the port with --set port={link.label}:5234"
        )
    ]
    assert read(path, Options(ports=((link, 5234),))).notes() == []


@pytest.mark.parametrize("kind", JUNK)
def test_other_programs_on_other_ports_are_only_counted(tmp_path, kind):
    assert of(tmp_path / "x.pcap", sent(300, JUNK[kind], OTHER, ("10.0.0.1", 5353))) == {}


@pytest.mark.parametrize("name", sorted(item.name for item in CAPTURES.glob("*.pcap*")))
def test_all_of_a_real_capture_is_cfs(name):
    found = read(CAPTURES / name)
    assert {flow.kind for flow in found.judge()} == {ConversationKind.CFS}
    assert found.notes() == []


def test_a_cut_frame_is_as_long_as_it_was(tmp_path):
    path = write(tmp_path / "x.pcap", datagrams(CAPTURES / "a_rover.pcap"), snap=60)
    assert {flow.kind for flow in read(path).judge()} == {ConversationKind.CFS}


@pytest.mark.parametrize("turned", [False, True])
def test_a_conversation_spans_its_first_and_last_datagram_in_any_order(turned):
    with closing(open_file(CAPTURES / "a_rover.pcap")) as source:
        (batch, *_) = source.batches()
    if turned:
        batch = batch.take(np.random.default_rng(1).permutation(len(batch)))
    context = Context()
    found = Conversations(context)
    for part in np.array_split(np.arange(len(batch)), 3):
        some = batch.take(part)
        found.add(some, ColumnDecoder(context).decode(some))
    times = {}
    for number in range(len(batch)):
        datagram = batch[number]
        times.setdefault((datagram.source, datagram.destination), []).append(datagram.time_ns)
    assert len(found.flows) > 2
    for flow in found.flows.values():
        own = times[flow.source, flow.destination]
        assert (flow.first_ns, flow.last_ns, flow.datagrams) == (min(own), max(own), len(own))
