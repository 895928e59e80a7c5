"""A terminal that takes nothing holds up nobody; what is drawn later is whole."""

import io
import os
import pty
import termios
import threading

import pytest
from rich.console import Console
from waiting import until

from edoras_tools.render.terminal.background import BackgroundStream, background


@pytest.fixture
def terminal():
    """Both ends of a pseudo terminal; what is written to it is gathered."""
    master, slave = pty.openpty()
    drawn = []

    def read():
        try:
            while data := os.read(master, 65536):
                drawn.append(data)
        except OSError:  # nobody has the other end any more
            return

    threading.Thread(target=read, daemon=True).start()
    yield slave, drawn
    os.close(slave)


def test_what_is_written_comes_out_in_order(terminal):
    slave, drawn = terminal
    with open(slave, "w", closefd=False) as stream, background(Console(file=stream)) as out:
        for number in range(200):
            out.write(f"{number} ")
            out.flush()
    assert stream.closed
    until(lambda: b"".join(drawn).split() == [b"%d" % number for number in range(200)])


def test_a_stopped_one_does_not_hold_up_who_writes(terminal):
    slave, drawn = terminal
    termios.tcflow(slave, termios.TCOOFF)
    with open(slave, "w", closefd=False) as stream, background(Console(file=stream)) as out:
        out.write("later")
        out.flush()
        assert not out.idle
        termios.tcflow(slave, termios.TCOON)
    until(lambda: b"".join(drawn) == b"later")


def test_one_that_fails_is_told():
    class Closed(io.StringIO):
        def write(self, _):
            raise OSError(5, "Input/output error")

    out = BackgroundStream(Closed())
    out.write("x")
    out.flush()
    out.finish()
    with pytest.raises(OSError, match="Input/output error"):
        out.write("y")


def test_a_pipe_is_written_to_as_ever(tmp_path):
    with (tmp_path / "x").open("w") as stream, background(Console(file=stream)) as out:
        assert out is None
