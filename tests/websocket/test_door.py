from __future__ import annotations

import socket
import threading
from contextlib import suppress

import foxglove_client as peer
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint
from edoras_tools.websocket import Door, Guard, door

ANY = Endpoint("127.0.0.1", 0)
UPGRADE = b"GET / HTTP/1.1\r\nHost: here\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"


class House:
    """A door, and who came through it."""

    def __init__(self, *origins):
        self.told, self.guests = [], []
        self.door = Door(ANY, Guard(origins, self.told.append), self._welcome)

    def _welcome(self, client, head):
        self.guests.append(head)
        client.sendall(b"welcome")
        client.close()

    def knock(self, *pieces):
        """Return the answer to what is sent piece by piece."""
        place = (self.door.endpoint.address, self.door.endpoint.port)
        with socket.create_connection(place, peer.PATIENCE_S) as client:
            for piece in pieces:
                client.sendall(piece)
            answer = b""
            with suppress(ConnectionError):  # what was not read is answered with a reset
                while more := client.recv(4096):
                    answer += more
        return answer


@pytest.fixture
def house():
    there = House("https://viz.example.org")
    yield there
    there.door.close()
    there.door.close()


@pytest.mark.parametrize(
    "origin", [b"", b"Origin: https://app.foxglove.dev\r\n", b"ORIGIN:https://viz.example.org  \r\n"]
)
def test_who_may_comes_in_with_all_that_was_sent(house, origin):
    request = UPGRADE + origin + b"\r\nand more"
    assert house.knock(request[:50], request[50:]) == b"welcome"
    assert house.guests[0].startswith(UPGRADE)
    assert not house.told


def test_other_pages_are_kept_out_and_told_once(house):
    for _ in range(2):
        answer = house.knock(UPGRADE + b"Origin: https://evil.example\r\n\r\n")
        assert answer.startswith(b"HTTP/1.1 403 Forbidden\r\n")
        assert answer.endswith(b"--allow-origin lets them in.\n")
    (told,) = house.told
    assert told.startswith(
        "a web page of https://evil.example was kept out of Foxglove; --allow-origin https:"
    )
    assert not house.guests


def test_one_origin_of_two_is_enough_to_be_kept_out(house):
    two = b"Origin: https://app.foxglove.dev\r\nOrigin: https://evil.example\r\n\r\n"
    assert house.knock(UPGRADE + two).startswith(b"HTTP/1.1 403 ")


def test_a_terminal_is_told_nothing_but_text_and_not_for_ever(house):
    house.knock(UPGRADE + b"Origin: \x1b[2J\xff" + b"x" * 5000 + b"\r\n\r\n")
    assert house.told[0].startswith("a web page of ?[2J?xxx")
    assert len(house.told[0]) < 300
    for number in range(20):
        house.knock(UPGRADE + b"Origin: https://%d.example\r\n\r\n" % number)
    assert len(house.told) == door._TOLD


def test_what_is_no_websocket_is_told_so(house):
    answer = house.knock(b"GET / HTTP/1.1\r\nHost: here\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 426 Upgrade Required\r\n")
    assert b"\r\nUpgrade: websocket\r\n" in answer


def test_who_never_says_what_he_wants_is_sent_away(house, monkeypatch):
    monkeypatch.setattr(door, "_PATIENCE_S", 0.05)
    assert house.knock(b"GET /") == b""
    assert house.knock(b"x" * (door._HEAD_BYTES + 1)) == b""
    assert not house.guests


def test_a_guest_that_cannot_be_taken_is_sent_away():
    def full(_client, _head):
        raise ConnectionRefusedError

    there = Door(ANY, Guard(), full)
    with socket.create_connection((there.endpoint.address, there.endpoint.port), peer.PATIENCE_S) as client:
        client.sendall(UPGRADE + b"\r\n")
        assert client.recv(1) == b""
    there.close()


def test_closing_sends_away_who_waits():
    there = House()
    with socket.create_connection(
        (there.door.endpoint.address, there.door.endpoint.port), peer.PATIENCE_S
    ) as client:
        peer.wait(lambda: there.door._knocking)
        there.door.close()
        assert client.recv(1) == b""


def test_a_port_in_use_is_one_line(house):
    taken = house.door.endpoint
    with pytest.raises(CaptureError, match=rf"127\.0\.0\.1:{taken.port}: cannot be listened on: .*in use"):
        Door(taken, Guard(), house._welcome)


@given(
    st.lists(
        st.sampled_from([b"Origin", b":", b" ", b"\r\n", b"\r", b"https://x", b"upgrade: websocket", b"\xff"])
    )
)
def test_any_head_is_judged(words):
    closed = Door.__new__(Door)
    closed._guard, closed._lock, closed._told = Guard(), threading.Lock(), set()
    answer = closed._refusal(b"".join(words) + b"\r\n\r\n")
    assert answer == b"" or answer.startswith(b"HTTP/1.1 4")
