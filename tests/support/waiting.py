"""Waiting, for tests that share the machine with others: until what must come has come, never for so long.

Whatever is awaited may take two minutes, for a machine may be busy with other work; what did not come by then
is told, with what the program that should have brought it wrote.
"""

from __future__ import annotations

import random
import select
import signal
import socket
import subprocess
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import warm

HOST = "127.0.0.1"
PATIENCE_S = 120


def until(condition, what="what was waited for"):
    """Wait for a condition; return what it gives. Where it stays away ``what`` says it, or is called to."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, f"not in {PATIENCE_S} s: {what() if callable(what) else what}"
        time.sleep(0.005)
    return found


class Stream:
    """A pipe's lines, read by a thread as they come: who writes is not held up, who reads does not hang."""

    def __init__(self, pipe):
        self.lines = []
        self.taken = 0
        self._thread = threading.Thread(target=self._read, args=(pipe,), daemon=True)
        self._thread.start()

    def _read(self, pipe):
        with pipe:
            self.lines.extend(pipe)

    @property
    def ended(self):
        return not self._thread.is_alive()

    def take(self):
        """Return the next line."""
        self.taken += 1
        return self.lines[self.taken - 1]

    def wait(self, seconds):
        """Wait for the end."""
        self._thread.join(seconds)

    def rest(self):
        """Return all that nobody took, up to the end."""
        self.wait(PATIENCE_S)
        assert self.ended, "somebody keeps the pipe open"
        taken, self.taken = self.taken, len(self.lines)
        return "".join(self.lines[taken:])


class Program:
    """A program beside the test, killed with the ``with`` block where it runs still.

    Args:
        arguments: its words.
        options: as ``subprocess.Popen`` takes them.
    """

    def __init__(self, *arguments, **options):
        usual = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = warm.Popen([*map(str, arguments)], text=True, **usual | options)
        self.out, self.err = Stream(self.process.stdout), Stream(self.process.stderr)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.process.kill()
        self.process.wait(PATIENCE_S)
        if self.process.stdin:
            self.process.stdin.close()
        self.out.rest()
        self.err.rest()

    def until(self, condition, what="what it should do"):
        """Wait for something that it must do; fail at once where it ends before."""

        def done():
            over = self.process.poll() is not None
            found = condition()
            assert found or not over, f"it ended before {what}: {self._told()}"
            return found

        return until(done, lambda: f"{what}: {self._told()}")

    def line(self, stream=None):
        """Return the next line that it writes, to standard output unless ``err`` is given."""
        stream = stream or self.out
        until(lambda: len(stream.lines) > stream.taken or stream.ended, lambda: f"a line: {self._told()}")
        assert len(stream.lines) > stream.taken, f"no line came: {self._told()}"
        return stream.take()

    def idle(self):
        """Tell whether it waits, all of its threads: a starved one is ready to run, and does not."""
        for _ in range(10):
            try:
                tasks = [path.read_text() for path in Path(f"/proc/{self.process.pid}/task").glob("*/stat")]
            except OSError:  # a thread has just ended
                return False
            if any(text.rpartition(")")[2].split()[0] != "S" for text in tasks):
                return False
            time.sleep(0.005)
        return True

    def end(self, how=signal.SIGINT, code=0):
        """End it as Ctrl-C does, or let it end by itself (None); return what it wrote and nobody took.

        Its exit code is ``code``, or one of those.
        """
        if how is not None:
            self.process.send_signal(how)
        until(lambda: self.process.poll() is not None, lambda: f"its end: {self._told()}")
        codes = code if isinstance(code, tuple) else (code,)
        assert self.process.returncode in codes, self._told()
        return self.out.rest(), self.err.rest()

    def _told(self):
        if self.out.ended or self.process.poll() is not None:
            self.err.wait(1)  # its last words
        return f"exit code {self.process.poll()}, it wrote {self.out.lines[-5:]}, {self.err.lines[-20:]}"


class Ear:
    """A UDP port at which nothing is lost: a thread takes what comes, so that no burst is too long for it."""

    def __init__(self):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        self.socket.bind((HOST, 0))
        self.socket.setblocking(False)
        self.port = self.socket.getsockname()[1]
        self._found, self._one_at_a_time, self._closing = [], threading.Lock(), False
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self._closing = True
        self._thread.join()
        self.socket.close()

    def take(self):
        """Return all that has come since the last time."""
        with self._one_at_a_time:
            self._hear()
            found, self._found = self._found, []
        return found

    def _hear(self):
        try:
            while True:
                self._found.append(self.socket.recv(65536))
        except BlockingIOError:
            return

    def _listen(self):
        while not self._closing:
            if select.select([self.socket], [], [], 0.05)[0]:
                with self._one_at_a_time:
                    self._hear()


def free_ports(count, kind=socket.SOCK_DGRAM):
    """Return ports that nobody has, and that nobody is given: they lie below those that systems hand out."""
    with ExitStack() as opened:
        found = []
        for port in random.SystemRandom().sample(range(24_000, 32_000), 8_000):
            try:
                opened.enter_context(socket.socket(socket.AF_INET, kind)).bind(("", port))
            except OSError:
                continue
            found.append(port)
            if len(found) == count:
                return found
    raise AssertionError("no port is free")


def receive(opened, count):
    """Return this many datagrams."""
    return [opened.recv(65536) for _ in range(count)]


def arrived_at(opened):
    """Return the datagrams that have arrived."""
    found = []
    while select.select([opened], [], [], 0)[0]:
        found.append(opened.recv(65536))
    return found
