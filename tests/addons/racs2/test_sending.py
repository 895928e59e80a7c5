"""What a recording holds of RACS2 reaches a WebSocket server of another implementation."""

import socket
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from racs2_peer import Talk, to_cfs, to_ros
from streams import frames as frames_of
from waiting import HOST
from websockets.sync.client import connect
from websockets.sync.server import serve

from edoras_tools.io.formats.pcapng import PcapngSink
from edoras_tools.io.frames.linklayer import Demux

SAID = [to_ros(f"topic_{number}", bytes(range(number, number + 100))) for number in range(40)]


@pytest.fixture
def recording(tmp_path):
    """Both sides speak; what the ROS side says goes the other way."""
    talk = Talk()
    for number, item in enumerate(SAID):
        talk.cfs.send_binary(item)
        if number % 10 == 0:
            talk.ros.send_binary(to_cfs(0x1894, b"up"))
        talk.pass_on()
    path = tmp_path / "racs2.pcapng"
    sink, demux = PcapngSink(path), Demux()
    sink.write(demux.demux(frames_of(talk.segments)))
    sink.close()
    return path


@contextmanager
def ros_side(**options):
    """A server; gives its port, what it was sent, and what became of each connection."""
    taken, ends = [], []

    def take(connection):
        connection.ping()
        taken.extend(connection)
        ends.append(connection.protocol.close_code)

    with serve(take, HOST, 0, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.socket.getsockname()[1], taken, ends
        server.shutdown()
        thread.join()


def test_a_server_gets_every_message_to_ros_and_a_clean_end(recording, call):
    with ros_side(subprotocols=["example-protocol"]) as (port, taken, ends):
        words = ("--to", "racs2", "--target", f"{HOST}:{port}", "--linger", "300ms", "--max", "--json")
        done = call("replay", recording, *words)
    assert done.code == 0, done.err
    assert taken == SAID
    assert ends == [1000]
    assert done.json()["notes"][0] == "4 of them go to cFS: --to racs2:up sends those"


def test_a_server_of_something_else_is_told(recording, call):
    with socket.create_server((HOST, 0)) as server:
        port = server.getsockname()[1]

        def refuse():
            with server.accept()[0] as connection:
                connection.recv(4096)
                connection.sendall(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n")
                connection.recv(4096)

        thread = threading.Thread(target=refuse)
        thread.start()
        done = call("replay", recording, "--to", "racs2", "--target", f"{HOST}:{port}", "--timeout", "500ms")
        thread.join()
    assert done.code == 1
    assert "did not answer as a receiver of RACS2" in done.err[-1]


def cfs_side(url, options=None):
    """Connect as cFS does, once somebody listens; return what came, until the end."""
    give_up = time.monotonic() + 10
    while True:
        try:
            with connect(url, **options or {}) as client:
                client.ping().wait(5)
                return list(client), client.protocol.close_code
        except ConnectionRefusedError:
            assert time.monotonic() < give_up
            time.sleep(0.02)


@pytest.mark.parametrize("subprotocols", [["example-protocol"], None])
def test_the_cfs_side_gets_every_message_to_it_and_a_clean_end(recording, call, subprotocols):
    with socket.create_server((HOST, 0)) as free:
        place = f"{HOST}:{free.getsockname()[1]}"
    with ThreadPoolExecutor(1) as pool:
        heard = pool.submit(cfs_side, f"ws://{place}/", {"subprotocols": subprotocols})
        done = call(
            "replay", recording, "--to", "racs2:up", "--target", place, "--linger", "300ms", "--max", "--json"
        )
    assert done.code == 0, done.err
    assert heard.result() == ([to_cfs(0x1894, b"up")] * 4, 1000)
    assert done.json()["notes"][0] == "40 of them go to ROS: --to racs2 sends those"


def test_a_cfs_side_that_does_not_come_is_told(recording, call):
    words = ("--to", "racs2:up", "--target", f"{HOST}:0", "--timeout", "200ms")
    done = call("replay", recording, *words)
    assert done.code == 1
    assert f"no cFS side connected to the WebSocket server at {HOST}:" in done.err[-1]


def test_what_asks_for_no_websocket_is_told(recording, call):
    with socket.create_server((HOST, 0)) as free:
        port = free.getsockname()[1]

    def ask():
        give_up = time.monotonic() + 10
        while time.monotonic() < give_up:
            try:
                with socket.create_connection((HOST, port)) as client:
                    client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
                    return client.recv(4096)
            except ConnectionRefusedError:
                time.sleep(0.02)
        return b""

    with ThreadPoolExecutor(1) as pool:
        answer = pool.submit(ask)
        done = call("replay", recording, "--to", "racs2:up", "--target", f"{HOST}:{port}", "--timeout", "2s")
    assert done.code == 1
    assert answer.result().startswith(b"HTTP/1.1 426 ")


def test_a_taken_port_is_told(recording, call):
    with socket.create_server((HOST, 0)) as taken:
        place = f"{HOST}:{taken.getsockname()[1]}"
        done = call("replay", recording, "--to", "racs2:up", "--target", place)
    assert (done.code, len(done.err)) == (1, 1)
    assert "choose another with --target" in done.err[0]
