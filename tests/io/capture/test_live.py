"""Live capture as a source: on loopback, which needs CAP_NET_RAW (``unshare -rn`` gives a user that)."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading

import pytest
from namespace import Cable, inside
from waiting import PATIENCE_S, until

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture.device import interfaces
from edoras_tools.io.capture.live import open_live
from edoras_tools.links.icmp import ICMP
from edoras_tools.model import Endpoint, concatenate

SENDER = """
import socket, sys
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sender.connect(("127.0.0.1", int(sys.argv[1])))
for number in range(int(sys.argv[2])):
    sender.send(number.to_bytes(8, "big") * 25)
"""


@pytest.fixture
def live():
    sources = []

    def make(*arguments, **options):
        sources.append(open_live(*arguments, **options))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def payloads(batches):
    return [one.payload for batch in batches for one, _ in of_each(batch)]


def of_each(batch):
    return [(batch[row], batch.frame_offset[row]) for row in range(len(batch))]


@pytest.mark.parametrize("interface", ["lo", "any"])
def test_everything_from_construction_to_stop(live, pair, interface):
    sender, port = pair
    wanted = [number.to_bytes(8, "big") for number in range(3000)]
    source = live(interface, [port])
    for payload in wanted[:1000]:
        sender.send(payload)

    def ready():
        for payload in wanted[1000:]:
            sender.send(payload)
        source.stop()

    source._ready = ready
    assert payloads(source.batches()) == wanted
    statistics = source.statistics
    assert (statistics.frames, statistics.datagrams, statistics.skipped) == (3000, 3000, 0)
    assert statistics.kernel_drops == 0
    assert statistics.bytes == 3000 * ({"lo": 14, "any": 20}[interface] + 28 + 8)
    assert (source.info.name, source.info.kind) == (interface, "live")


TAGS = {b"none": "", b"802.1Q": "81002007", b"priority": "81006000", b"802.1ad": "88a80064 81000008"}


@pytest.mark.parametrize(("interface", "ends"), [("cable", 1), ("any", 2)])
def test_vlan_tags_as_the_kernel_gives_them(live, interface, ends):
    """Of what comes in it removes a tag, of what goes out it does not; ``any`` sees both ends."""

    def work():
        cable, found = Cable("cable"), []
        cable.lay()
        source = live(interface, [1234])
        for payload, tags in TAGS.items():
            cable.send(payload, tags=bytes.fromhex(tags))
        for batch in source.batches():
            found += [(one.payload, batch.data[at + 12 : at + 22]) for one, at in of_each(batch)]
            if source.statistics.frames == ends * len(TAGS):
                source.stop()
        return found

    found = inside(work)
    assert sorted(payload for payload, _ in found) == sorted([*TAGS] * ends)
    if interface == "cable":  # a cooked header has no place for a tag
        assert all(bytes(after).startswith(bytes.fromhex(TAGS[payload] + "0800")) for payload, after in found)


def test_ready_is_said_when_nothing_can_be_missed(live, pair):
    sender, port = pair
    said = threading.Event()
    source = live("lo", [port], ready=said.set)
    batches = source.batches()
    waiting = threading.Thread(target=lambda: said.wait(PATIENCE_S) and sender.send(b"the first"))
    waiting.start()
    assert until(lambda: payloads([next(batches)])) == [b"the first"]
    waiting.join()
    assert source.started.is_set()


def test_a_sender_in_another_process(live, pair):
    _, port = pair
    source = live("lo", [port])
    child = subprocess.Popen([sys.executable, "-c", SENDER, str(port), "20000"])
    threading.Thread(target=lambda: (child.wait(), source.stop())).start()
    whole = concatenate([batch for batch in source.batches() if len(batch)])
    assert child.returncode == 0
    assert source.statistics.kernel_drops == 0
    numbers = [int.from_bytes(whole.data[at : at + 8].tobytes(), "big") for at in whole.offset]
    assert numbers == list(range(20000))
    assert whole.number.tolist() == list(range(1, 20001))
    assert set(whole.destination_port.tolist()) == {port}


def test_a_consumer_that_sleeps_loses_nothing(live, pair):
    # The thread takes the frames out of the ring while nobody asks for batches.
    sender, port = pair
    source = live("lo", [port])
    for number in range(30):
        sender.send(bytes([number]))
        threading.Event().wait(0.03)  # each in a block of its own
    assert source.statistics.datagrams == 0
    source.stop()
    assert payloads(source.batches()) == [bytes([number]) for number in range(30)]


def test_no_such_interface(live):
    with pytest.raises(CaptureError, match=r"^nonesuch0: no such interface; there are .*lo"):
        live("nonesuch0")


def test_a_port_that_is_none(live):
    with pytest.raises(CaptureError, match="70000 is not a UDP or TCP port"):
        live("lo", [70000])


def test_interfaces():
    assert "lo" in interfaces()


@pytest.mark.parametrize("interface", ["lo", "any"])
@pytest.mark.parametrize(("family", "host"), [(socket.AF_INET, "127.0.0.1"), (socket.AF_INET6, "::1")])
def test_the_error_about_a_closed_port_and_no_other(live, pair, interface, family, host):
    """Nobody listens on two ports; the filter is for one of them."""
    sender, port = pair
    with socket.socket(family, socket.SOCK_DGRAM) as first, socket.socket(family, socket.SOCK_DGRAM) as other:
        first.bind((host, 0))
        other.bind((host, 0))
        closed, outside = first.getsockname()[1], other.getsockname()[1]
    source = live(interface, [port, closed])
    with socket.socket(family, socket.SOCK_DGRAM) as away:
        for number in range(20):
            away.sendto(bytes([number]), (host, closed))
            away.sendto(bytes([number]), (host, outside))
    sender.send(b"the last")
    found = []
    for batch in source.batches():
        found += [one for one, _ in of_each(batch)]
        if found and found[-1].payload == b"the last":
            source.stop()
    errors = [ICMP.quoted(one) for one in found if one.destination.port == 0]
    assert [one.payload for one in errors] == [bytes([number]) for number in range(20)]
    assert {one.destination for one in errors} == {Endpoint(host, closed)}
    assert [one.payload for one in found if one.destination.port == closed] == [one.payload for one in errors]
