"""What a recording holds of RACS2 reaches a WebSocket server of another implementation."""

import socket
import threading
from contextlib import contextmanager

import pytest
from racs2_peer import Talk, to_cfs, to_ros
from streams import frames as frames_of
from waiting import HOST
from websockets.sync.server import serve

from edoras_tools.io.formats.pcapng.writer import PcapngSink
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
    assert done.json()["notes"][0] == ("4 of them go to cFS: the ROS side sends those, which is the server")


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


def test_nothing_is_sent_towards_cfs(recording, call):
    done = call("replay", recording, "--to", "racs2:up")
    assert (done.code, len(done.err)) == (2, 1)
    assert "nothing is sent on racs2 towards the flight software" in done.err[0]
