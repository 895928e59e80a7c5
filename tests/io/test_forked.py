"""Values between two processes."""

import fcntl
import pickle
import signal
import socket
import struct
import sys
import termios
import threading

import pytest
from waiting import until

from edoras_tools.io.forked import receive, send

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="there is one process elsewhere")


def unread(link):
    return struct.unpack("i", fcntl.ioctl(link, termios.TIOCOUTQ, bytes(4)))[0]


@pytest.mark.parametrize("first", [3, 8, 500])
def test_a_value_that_a_signal_divides_is_whole(first):
    """As where the process is stopped and goes on: what came until then is returned at once."""
    here, there = socket.socketpair()
    value = list(range(1000))
    data = pickle.dumps(value, protocol=5)
    data = len(data).to_bytes(8, "big") + data
    handled, main = threading.Event(), threading.get_ident()

    def sender():
        there.sendall(data[:first])
        until(lambda: not unread(there), "the first part is taken")
        signal.pthread_kill(main, signal.SIGUSR1)
        assert handled.wait(20)
        there.sendall(data[first:])

    before = signal.signal(signal.SIGUSR1, lambda *_: handled.set())
    thread = threading.Thread(target=sender)
    try:
        with here, there:
            thread.start()
            found = receive(here)
            thread.join()
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert handled.is_set()
    assert found == value


@pytest.mark.parametrize("kept", [0, 5, 8, 20])
def test_one_that_ends_early_is_told(kept):
    here, there = socket.socketpair()
    with here:
        with there:
            send(there, "a value")
        data = here.recv(100)
    here, there = socket.socketpair()
    with here:
        with there:
            there.sendall(data[:kept])
        with pytest.raises(EOFError):
            receive(here)
