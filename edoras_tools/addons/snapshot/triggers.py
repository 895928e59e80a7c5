"""Triggers of a snapshot other than datagrams: a signal, a key, a datagram on a socket, a doctor's rule."""

from __future__ import annotations

import os
import signal
import socket
import stat
import threading
import time
from collections import deque
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Final

from edoras_tools.diagnosis.case import Capture
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.diagnosis.verdict import Severity
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from edoras_tools.decode.context import Context
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.pipelines.interrupt import Keys

_SIGNAL: Final = getattr(signal, "SIGUSR1", None)
_MOST_BYTES: Final = 256
_ANSWER_S: Final = 5.0
_JUDGE_NS: Final = SECOND
"""Least time between two examinations by the doctor."""
_JUDGE_TIMES: Final = 5
"""Least pause after an examination, as a multiple of its duration."""
_JUDGE_ROWS: Final = 200_000
"""Most datagrams that the doctor examines, from the newest on; of at least one batch."""


class Triggers:
    """Triggers of this machine; none by default.

    Args:
        keys: the keyboard: ``t`` and Enter fire.
        listener: a bound socket, on which every datagram fires.
    """

    def __init__(self, keys: Keys | None = None, listener: socket.socket | None = None) -> None:
        self._keys, self._listener = keys, listener
        self._signals: list[str] = []
        self._senders: list[str] = []

    def signalled(self, *_: object) -> None:
        """Fire; for a signal handler."""
        self._signals.append("signal USR1")

    def fired(self) -> list[str]:
        """Return the reasons for snapshots since the last call."""
        reasons, self._signals = self._signals, []
        if self._keys is not None and set(self._keys.pressed()) & set("t\r\n"):
            reasons.append("a key")
        while self._listener is not None:
            try:
                text, sender = self._listener.recvfrom(_MOST_BYTES)
            except OSError:
                break
            words = " ".join(text.decode(errors="replace").split())
            reasons.append(f"asked for: {words}" if words else "asked for on the socket")
            if sender:
                self._senders.append(sender)
        return reasons

    def answer(self, text: str) -> None:
        """Answer the programs that asked on the socket."""
        senders, self._senders = self._senders, []
        for sender in senders:
            with suppress(OSError):
                assert self._listener is not None, "it was asked there"
                self._listener.sendto(text.encode(), sender)


@contextmanager
def listening(keys: Keys | None = None, path: Path | None = None) -> Iterator[Triggers]:
    """Open the triggers of this machine: SIGUSR1, and keys and a socket if they are given.

    Args:
        path: path of a Unix socket to create, for this user alone; it is removed at the end.

    Raises:
        CaptureError: the socket cannot be created, or another program has it.
    """
    listener = _bound(path) if path is not None else None
    triggers = Triggers(keys, listener)
    handled = _SIGNAL is not None and threading.current_thread() is threading.main_thread()
    before = signal.signal(_SIGNAL, triggers.signalled) if handled and _SIGNAL is not None else None
    try:
        yield triggers
    finally:
        if handled and _SIGNAL is not None:
            signal.signal(_SIGNAL, before)
        if listener is not None and path is not None:
            listener.close()
            path.unlink(missing_ok=True)


def ask(path: Path, text: str = "") -> str:
    """Ask the recorder that listens on a socket for a snapshot; return its answer.

    Raises:
        CaptureError: no recorder listens there, or none answers.
    """
    with _unix() as asking:
        asking.settimeout(_ANSWER_S)
        try:
            asking.bind("")  # the system chooses a name for the answer
            asking.connect(str(path))
            asking.send(text.encode()[:_MOST_BYTES])
            return asking.recv(4096).decode(errors="replace")
        except TimeoutError:
            raise CaptureError(f"{path}: the recorder did not answer within {_ANSWER_S:g} s") from None
        except OSError as error:
            raise CaptureError(
                f"{path}: no recorder listens there ({error.strerror}); start one with record --snapshot "
                f"--socket {path}"
            ) from error


def _unix() -> socket.socket:
    if not hasattr(socket, "AF_UNIX"):
        raise ConfigError("--socket and --fire need Unix sockets, which this system does not have")
    return socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)


def _bound(path: Path) -> socket.socket:
    if path.exists() and _answers(path):
        raise CaptureError(f"{path}: another recorder listens there; name another socket")
    listener = _unix()
    try:
        if path.exists() and stat.S_ISSOCK(path.lstat().st_mode):
            path.unlink()  # left by a recorder that was killed
        before = os.umask(0o177)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
    except OSError as error:
        listener.close()
        raise CaptureError(f"{path}: cannot listen there: {error.strerror or error}") from error
    listener.setblocking(False)
    return listener


def _answers(path: Path) -> bool:
    with _unix() as peer, suppress(OSError):
        peer.connect(str(path))
        return True
    return False


class RuleTrigger:
    """Fires when the doctor finds something new in the newest datagrams.

    Args:
        rules: the rules whose verdicts fire.
        any_error: whether any verdict that is an error fires.
        apart: whether to judge in a thread, so that a live source is read on.
    """

    def __init__(self, context: Context, rules: frozenset[str], *, any_error: bool, apart: bool) -> None:
        self._context, self._rules, self._any = context, rules, any_error
        self._apart = apart
        self._thread: threading.Thread | None = None
        self._due_ns = 0
        self._judged_ns = 0
        self._known: set[tuple[str, str | None, int | None]] = set()
        self._found: deque[tuple[int, str]] = deque()

    def new_hits(self) -> list[tuple[int, str]]:
        """Return the triggers since the last call: time and reason."""
        return [self._found.popleft() for _ in range(len(self._found))]

    def look(self, batches: Iterable[tuple[PacketBatch, Columns]], newest_ns: int) -> None:
        """Start to judge the kept batches, if it is time.

        Args:
            batches: batches, the oldest first.
            newest_ns: time of the newest datagram, which new verdicts get as their time.
        """
        if not (self._rules or self._any) or (self._thread and self._thread.is_alive()):
            return
        now = time.monotonic_ns() if self._apart else newest_ns
        if now < self._due_ns or newest_ns == self._judged_ns:
            return
        waiting: list[tuple[PacketBatch, Columns]] = []
        rows = 0
        for batch, columns in reversed(list(batches)):
            rows += len(batch)
            if waiting and rows > _JUDGE_ROWS:
                break
            waiting.append((batch, columns))
        self._judged_ns, self._due_ns = newest_ns, now + _JUDGE_NS
        if self._apart:
            self._thread = threading.Thread(target=self._judge, args=(waiting[::-1], newest_ns), daemon=True)
            self._thread.start()
        else:
            self._judge(waiting[::-1], newest_ns)

    def end(self) -> None:
        """Wait for the judgement that is running."""
        if self._thread is not None:
            self._thread.join()

    def _judge(self, batches: list[tuple[PacketBatch, Columns]], newest_ns: int) -> None:
        began = time.monotonic_ns()
        examination = Examination(self._context)
        for batch, columns in batches:
            examination.add(batch, columns)
        reasons = {
            (item.rule, item.link, item.msg_id): item.reason
            for item in examination.diagnose(Capture()).verdicts
            if item.rule in self._rules or (self._any and item.severity >= Severity.ERROR)
        }
        fired = [f"rule {key[0]}: {reason}" for key, reason in reasons.items() if key not in self._known]
        self._known = set(reasons)
        self._found.extend((newest_ns, reason) for reason in fired)
        if self._apart:
            self._due_ns = time.monotonic_ns() + max(_JUDGE_NS, _JUDGE_TIMES * (time.monotonic_ns() - began))
