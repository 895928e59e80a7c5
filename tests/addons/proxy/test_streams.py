"""The relay of TCP: bytes, ends, faults and counts, on real sockets."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from contextlib import ExitStack, contextmanager, suppress

import pytest
import websockets
from racs2_peer import to_cfs, to_ros
from streams import sbn_messages
from waiting import PATIENCE_S, until

from edoras_tools.addons.proxy import streams
from edoras_tools.addons.proxy.plan import ProxyPlan
from edoras_tools.addons.proxy.streams import StreamProxy
from edoras_tools.addons.racs2.link import RACS2
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.links.sbn import SBN
from edoras_tools.model import Endpoint
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import parse_rule

HELLO = sbn_messages(1)[0]
"""The message with which a client begins."""


@contextmanager
def relay(target, *rules, link=SBN, cut_ns=0):
    plan = ProxyPlan(
        link=link,
        listen=Endpoint("127.0.0.1", 0),
        targets=(Endpoint("127.0.0.1", target),),
        faults=FaultPlan(tuple(map(parse_rule, rules))),
    )
    made = StreamProxy(plan, cut_ns)
    thread = threading.Thread(target=made.run)
    thread.start()
    try:
        yield made
    finally:
        made.stop()
        thread.join(PATIENCE_S)
        made.close()


@pytest.fixture
def server():
    with socket.create_server(("127.0.0.1", 0)) as made:
        made.settimeout(PATIENCE_S)
        yield made


@pytest.fixture
def connected():
    """A function: both ends of a connection through a relay, after the message with which it begins."""
    ends = []

    def connect(made, server):
        client = socket.create_connection(("127.0.0.1", made.endpoint.port))
        client.sendall(HELLO)
        accepted, _ = server.accept()
        ends.extend((client, accepted))
        for end in ends:
            end.settimeout(PATIENCE_S)
        assert accepted.recv(len(HELLO)) == HELLO
        return client, accepted

    yield connect
    for end in ends:
        end.close()


def read_all(end):
    data = b""
    while part := end.recv(65536):
        data += part
    return data


def test_every_byte_both_ways_and_each_end(server, connected):
    there, back = b"".join(sbn_messages(3000)), b"".join(sbn_messages(2000, 50))
    with relay(server.getsockname()[1]) as made:
        client, accepted = connected(made, server)
        found = {}
        reader = threading.Thread(target=lambda: found.update(there=read_all(accepted)))
        reader.start()
        client.sendall(there)
        client.shutdown(socket.SHUT_WR)
        reader.join(PATIENCE_S)
        accepted.sendall(back)
        accepted.close()
        assert read_all(client) == back
        client.close()
        assert found["there"] == there
        until(lambda: not made._open)
    summary = made.summary()
    assert summary["bytes_to_target"] == len(HELLO) + len(there)
    assert summary["bytes_to_client"] == len(back)
    assert (summary["connections"], summary["cut"], summary["refused"], summary["silent"]) == (1, 0, 0, 0)


def test_what_is_slow_to_read_is_not_kept_here(server, connected):
    with relay(server.getsockname()[1]) as made:
        client, accepted = connected(made, server)
        client.setblocking(False)
        sent = 0

        def held_up():
            nonlocal sent
            with suppress(BlockingIOError):
                while sent < 200_000_000:
                    sent += client.send(bytes(1 << 16))
            return made._open[0].pipes[0].size >= 1 << 20

        until(held_up)
        assert held_up()
        assert made._open[0].pipes[0].size < 2 << 20
        until(lambda: made._wait_s() > 0)  # it sleeps until there is room
        client.close()
        assert len(read_all(accepted)) == sent


def test_bytes_are_late_and_in_order(server, connected):
    with relay(server.getsockname()[1], "delay:80ms,to=cfs") as made:
        client, accepted = connected(made, server)
        began = time.monotonic()
        client.sendall(b"one")
        client.sendall(b"two")
        client.close()
        assert read_all(accepted) == b"onetwo"
        assert time.monotonic() - began >= 0.08
    assert made.summary()["faults"][0]["struck"] >= 1


def test_a_connection_is_cut(server, connected):
    with relay(server.getsockname()[1], cut_ns=50_000_000) as made:
        client, accepted = connected(made, server)
        for end in (client, accepted):
            with pytest.raises(ConnectionResetError):
                end.recv(10)
        until(lambda: made.cut == 1)


def test_a_target_that_is_not_there_is_counted():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        with relay(probe.getsockname()[1]) as made:
            with socket.create_connection(("127.0.0.1", made.endpoint.port)) as client:
                client.settimeout(PATIENCE_S)
                client.sendall(HELLO)
                assert client.recv(1) == b""
            until(lambda: made.refused == 1)
    assert made.silent == 0


def test_a_target_that_does_not_answer_holds_up_no_other_connection(connected, monkeypatch):
    monkeypatch.setattr(streams, "_CONNECT_NS", 1 << 62)
    with socket.create_server(("127.0.0.1", 0), backlog=0) as server, ExitStack() as filled:
        server.settimeout(PATIENCE_S)
        with relay(server.getsockname()[1]) as made:
            client, accepted = connected(made, server)
            for _ in range(3):  # the server answers no more than it has room for
                waiting = filled.enter_context(socket.socket())
                waiting.setblocking(False)
                waiting.connect_ex(server.getsockname())
            late = filled.enter_context(socket.create_connection(("127.0.0.1", made.endpoint.port)))
            late.sendall(HELLO)
            until(lambda: len(made._open) == 2 and made._open[1].target is not None)
            accepted.sendall(b"goes on")
            assert client.recv(7) == b"goes on"
            assert (made.connections, made.refused) == (1, 0)
            monkeypatch.setattr(streams, "_CONNECT_NS", 0)
            assert late.recv(1) == b""
            assert made.refused == 1


@pytest.mark.parametrize(
    "leave", ["close", "half-close", "reset", "reset while its bytes are held back", "part"]
)
def test_the_target_hears_nothing_of_a_client_that_sent_no_message(server, connected, leave):
    held = leave.endswith("held back")
    with relay(server.getsockname()[1], *(["delay:1h,to=cfs"] if held else [])) as made:
        with socket.create_connection(("127.0.0.1", made.endpoint.port)) as scan:
            until(lambda: made._open)
            if held:
                scan.sendall(HELLO)
                until(lambda: made._open[0].pipes[0].waiting)
            if leave == "part":
                scan.sendall(HELLO[:-1])
                until(lambda: made._open[0].pipes[0].waiting)
            if leave.startswith("reset"):
                scan.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            if leave == "half-close":
                scan.shutdown(socket.SHUT_WR)
                scan.settimeout(PATIENCE_S)
                assert scan.recv(1) == b""
        until(lambda: not made._open)
        assert made.silent == 1
        server.setblocking(False)
        with pytest.raises(BlockingIOError):
            server.accept()


@pytest.mark.parametrize("data", [HELLO * 3 + HELLO[:-1], b"\xff" * 40])
def test_the_first_message_alone_is_measured_or_what_is_none(server, data, monkeypatch):
    measured, length = [], type(SBN.framing).length

    def measure(self, view, at, end):
        measured.append(at)
        return length(self, view, at, end)

    monkeypatch.setattr(type(SBN.framing), "length", measure)
    with relay(server.getsockname()[1]) as made:
        client = socket.create_connection(("127.0.0.1", made.endpoint.port))
        with client:
            client.sendall(data)
            end = server.accept()[0]
            with end:
                end.settimeout(PATIENCE_S)
                assert end.recv(len(data), socket.MSG_WAITALL) == data
    assert set(measured) == {0}


def test_bytes_before_the_end_reach_the_target_though_the_client_has_left(server):
    with relay(server.getsockname()[1], "delay:50ms,to=cfs") as made:
        with socket.create_connection(("127.0.0.1", made.endpoint.port)) as client:
            client.sendall(HELLO + b"all of it")
        accepted, _ = server.accept()
        with accepted:
            accepted.settimeout(PATIENCE_S)
            assert read_all(accepted) == HELLO + b"all of it"
    assert (made.connections, made.silent) == (1, 0)


def test_racs2_bridges_through_it():
    async def talk():
        heard = []

        async def ros(connection):
            async for message in connection:
                heard.append(message)
                await connection.send(to_cfs(0x1894, message[32:40]))

        async with websockets.serve(ros, "127.0.0.1", 0) as serving:
            port = serving.sockets[0].getsockname()[1]
            with relay(port, "delay:5ms", link=RACS2) as made:
                async with websockets.connect(f"ws://127.0.0.1:{made.endpoint.port}/") as cfs:
                    for number in range(20):
                        await cfs.send(to_ros("/topic", bytes([number])))
                        assert await cfs.recv() == to_cfs(0x1894, bytes([number]).ljust(8, b"\0"))
        return heard

    assert len(asyncio.run(talk())) == 20


def test_what_a_stream_cannot_have_is_refused_before_anything_is_opened():
    with pytest.raises(ConfigError, match="cannot have this fault"), relay(1, "drop:0.1"):
        pass


def test_a_port_in_use(server):
    plan = ProxyPlan(SBN, Endpoint("127.0.0.1", server.getsockname()[1]), (Endpoint("127.0.0.1", 1),))
    with pytest.raises(CaptureError, match="--listen"):
        StreamProxy(plan)
