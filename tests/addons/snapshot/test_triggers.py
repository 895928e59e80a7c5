"""Triggers of this machine: a signal, keys, a socket."""

import os
import signal
import socket
import stat
import threading

import pytest
from waiting import until

from edoras_tools.addons.snapshot.sink import Triggers, ask, listening
from edoras_tools.errors import CaptureError


class Keys:
    def __init__(self, *pressed):
        self.left = list(pressed)

    def pressed(self):
        return self.left.pop(0) if self.left else ""


def test_a_signal_fires_and_its_handler_is_put_back():
    before = signal.getsignal(signal.SIGUSR1)
    with listening() as triggers:
        assert triggers.fired() == []
        os.kill(os.getpid(), signal.SIGUSR1)
        assert until(triggers.fired) == ["signal USR1"]
        assert triggers.fired() == []
    assert signal.getsignal(signal.SIGUSR1) is before


@pytest.mark.parametrize(("pressed", "reasons"), [("t", ["a key"]), ("x\n", ["a key"]), ("q", []), ("", [])])
def test_keys(pressed, reasons):
    assert Triggers(Keys(pressed)).fired() == reasons


def test_a_socket_is_asked_and_answers(tmp_path):
    path = tmp_path / "s"
    with listening(path=path) as triggers:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        answers = []
        asking = threading.Thread(target=lambda: answers.append(ask(path, "the  arm\nstopped")))
        asking.start()
        assert until(triggers.fired) == ["asked for: the arm stopped"]
        triggers.answer("a.mcap")
        asking.join()
        assert answers == ["a.mcap"]
        with pytest.raises(CaptureError, match="another recorder listens there"), listening(path=path):
            pass
    assert not path.exists()


def test_any_program_may_ask_without_an_answer(tmp_path):
    with listening(path=tmp_path / "s") as triggers:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as plain:
            plain.sendto(b"", str(tmp_path / "s"))
        assert until(triggers.fired) == ["asked for on the socket"]
        triggers.answer("nobody hears it")


def test_bad_places(tmp_path):
    (tmp_path / "file").write_text("kept")
    for path, words in [
        (tmp_path / "file", "cannot listen there"),
        (tmp_path / "no/s", "cannot listen there"),
    ]:
        with pytest.raises(CaptureError, match=words), listening(path=path):
            pass
    assert (tmp_path / "file").read_text() == "kept"
    with pytest.raises(CaptureError, match="no recorder listens there"):
        ask(tmp_path / "nothing")


def test_the_socket_of_a_killed_recorder_is_replaced(tmp_path):
    path = tmp_path / "s"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as killed:
        killed.bind(str(path))
    with listening(path=path) as triggers:
        assert triggers.fired() == []
