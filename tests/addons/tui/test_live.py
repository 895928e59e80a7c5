"""A live source: packets are followed as they come, the oldest give way, and quitting lets go of it all."""

import socket

import pytest
from places import ROOT

from edoras_tools.decode import Options
from edoras_tools.io.net.buffer import UdpSource
from edoras_tools.links.bare import CI
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.reading import Limits
from edoras_tools.pipelines.workbench import open_files

TWIST = (
    bytes.fromhex("1827 0000 0045 0100")
    + (52).to_bytes(8, "little") * 2
    + bytes.fromhex("00010000")
    + bytes(48)
)


class Sender:
    def __init__(self):
        self.source = UdpSource([Endpoint("127.0.0.1", 0)])
        self.port = self.source.endpoints[0].port
        self.options = Options(ports=((CI, self.port),))

    def send(self, count):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for _ in range(count):
                out.sendto(TWIST, ("127.0.0.1", self.port))


def test_what_comes_is_followed_until_the_user_looks_back(drive):
    sender = Sender()

    async def script(hands):
        app = hands.app
        await hands.until(lambda: "waiting for the first packet" in hands.lines(app.packets)[1])
        sender.send(60)
        await hands.until(lambda: hands.number == 60, "the last packet")
        assert "0x1827" in hands.lines(app.packets)[-1]
        await hands.press("k")
        assert not app.packets.follow
        sender.send(5)
        await hands.until(lambda: len(app.store) == 65, "five more")
        assert hands.number == 59
        await hands.press("F")
        sender.send(1)
        await hands.until(lambda: hands.number == 66, "followed again")
        await hands.press("question_mark")
        sender.send(1)
        await hands.until(lambda: hands.number == 67, "behind the help too")
        await hands.press("escape", "r")
        await hands.until(lambda: any("67" in line for line in hands.lines(app.routes)), "counted")

    drive(script, source=sender.source, options=sender.options, follow=True)


@pytest.mark.long
def test_a_filter_holds_for_what_comes_later(drive):
    sender = Sender()

    async def script(hands):
        await hands.filter("number in 5..8")
        sender.send(6)
        await hands.until(lambda: len(hands.app.store) == 2, "two of six")
        sender.send(6)
        await hands.until(
            lambda: hands.app.store.packets == 12 and len(hands.app.store) == 4, "four of twelve"
        )

    drive(script, source=sender.source, options=sender.options)


@pytest.mark.long
def test_the_oldest_packets_give_way_and_the_cursor_stays(drive):
    sender = Sender()

    async def script(hands):
        app = hands.app
        for _ in range(40):
            before = app.ledger.datagrams
            sender.send(50)
            await hands.until(lambda before=before: app.ledger.datagrams == before + 50, "all arrived")
            if app.store.forgotten:
                break
        assert app.store.forgotten
        assert app.store.packets + app.store.forgotten == app.ledger.datagrams
        assert "oldest removed" in str(app._status_right.render())
        block, index = app.store.locate(app.packets.cursor)
        await hands.until(lambda: hands.number == int(block.batch.number[index]), "what is under the cursor")

    drive(script, source=sender.source, options=sender.options, limit=100_000)


@pytest.mark.long
def test_enough_is_enough(drive):
    sender = Sender()

    async def script(hands):
        sender.send(9)
        await hands.until(lambda: not hands.app.reading, "the end")
        assert len(hands.app.store) == 5

    drive(script, source=sender.source, options=sender.options, limits=Limits(5))


@pytest.mark.long
def test_a_file_that_is_too_large_is_shown_from_its_beginning(drive):
    async def script(hands):
        app = hands.app
        await hands.until(lambda: not app.reading, "the end")
        assert 1377 <= app.store.packets < 1377 + 1544
        assert "packets were read: the limit is" in hands.status
        assert not app.failure

    captures = [ROOT / f"samples/captures/{name}.pcap" for name in ("f_sbn_disconnect", "e_ci_errors")]
    drive(script, source=open_files(captures), limit=1000)


def test_a_file_that_is_cut_off_is_shown_as_far_as_it_goes(drive, tmp_path):
    whole = (ROOT / "samples/captures/a_rover.pcap").read_bytes()
    (tmp_path / "cut.pcap").write_bytes(whole[:-7])

    async def script(hands):
        app = hands.app
        await hands.until(lambda: not app.reading, "the end")
        assert app.store.packets == 1826
        assert "cut.pcap" in app.failure
        assert "cut.pcap" in hands.status

    drive(script, source=open_files([tmp_path / "cut.pcap"]))
