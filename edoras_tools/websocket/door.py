"""A port that clients knock at: whoever asks for a WebSocket, and may, is let in."""

from __future__ import annotations

import contextlib
import os
import re
import socket
import threading
import time
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import CaptureError
from edoras_tools.model import Endpoint

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.websocket.guard import Guard

MOST: Final = 64
"""Clients at a time, and as many at the door; each has threads and buffers of its own."""
_PAUSE_S: Final = 0.05
_PATIENCE_S: Final = 5.0
_HEAD_BYTES: Final = 1 << 14
_TOLD: Final = 8
"""Origins that are told; a page could have any number of them."""
_FIELD: Final = re.compile(rb"\r\n([!-9;-~]+):[ \t]*(.*?)[ \t]*(?=\r\n)")


class Door:
    """Listens from construction on.

    Args:
        listen: address and port; port 0 is the system's choice.
        guard: who may come.
        welcome: given a client and what it has sent so far, on a thread of its own; the client is closed
            where it raises ``OSError`` or ``RuntimeError``.

    Attributes:
        endpoint: what is listened on.

    Raises:
        CaptureError: the address cannot be listened on.
    """

    def __init__(
        self, listen: Endpoint, guard: Guard, welcome: Callable[[socket.socket, bytes], None]
    ) -> None:
        self._guard, self._welcome = guard, welcome
        self._lock = threading.Lock()
        self._knocking: dict[socket.socket, threading.Thread] = {}
        self._told: set[str] = set()
        self._closed = False
        self._socket = _listen(listen)
        self.endpoint = Endpoint(*self._socket.getsockname()[:2])
        self._thread = threading.Thread(target=self._receive, name="foxglove door", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where clients connect to."""
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(self.endpoint.address, self.endpoint.address)  # noqa: S104
        return f"ws://{Endpoint(host, self.endpoint.port)}"

    def close(self) -> None:
        """Let nobody in any more; calling it again does nothing."""
        self._closed = True
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes the thread
        self._thread.join()
        self._socket.close()
        with self._lock:
            knocking = dict(self._knocking)
        for client, thread in knocking.items():
            with contextlib.suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            thread.join()

    def _receive(self) -> None:
        while not self._closed:
            try:
                client, _ = self._socket.accept()
            except OSError:
                if not self._closed:
                    time.sleep(_PAUSE_S)  # whoever came has gone, or there are no descriptors for more
                continue
            thread = threading.Thread(target=self._answer, args=(client,), name="foxglove knock", daemon=True)
            with self._lock:
                crowded = len(self._knocking) >= MOST
                if not crowded:
                    self._knocking[client] = thread
            try:
                if crowded:
                    client.close()
                else:
                    thread.start()
            except RuntimeError:  # the system has no more threads
                self._forget(client)
                client.close()

    def _answer(self, client: socket.socket) -> None:
        try:
            client.settimeout(_PATIENCE_S)
            head = _head(client)
            refusal = self._refusal(head)
            if refusal:
                client.sendall(refusal)
                client.close()
            else:
                client.settimeout(None)
                self._welcome(client, head)
        except (OSError, RuntimeError):  # it is gone already, or the system has no more of something
            client.close()
        finally:
            self._forget(client)

    def _forget(self, client: socket.socket) -> None:
        with self._lock:
            self._knocking.pop(client, None)

    def _refusal(self, head: bytes) -> bytes:
        """Return the answer to a request that is not granted; nothing where it is."""
        fields = [
            (name.lower(), value) for name, value in _FIELD.findall(head.partition(b"\r\n\r\n")[0] + b"\r\n")
        ]
        if not any(name == b"upgrade" and value.lower() == b"websocket" for name, value in fields):
            return _response(
                "426 Upgrade Required",
                "This port speaks Foxglove's WebSocket protocol.",
                "Upgrade: websocket",
            )
        for name, value in fields:
            origin = value.decode("latin-1")
            if name == b"origin" and not self._guard.admits(origin):
                self._tell(re.sub(r"[^!-~]", "?", origin)[:100])
                return _response(
                    "403 Forbidden", "Pages of this origin are kept out; --allow-origin lets them in."
                )
        return b""

    def _tell(self, origin: str) -> None:
        with self._lock:
            if origin in self._told or len(self._told) >= _TOLD:
                return
            self._told.add(origin)
        if self._guard.tell is not None:
            self._guard.tell(
                f"a web page of {origin} was kept out of Foxglove; --allow-origin {origin} lets it in"
            )


def _head(client: socket.socket) -> bytes:
    """Wait for a request's head, and return what has come: it may be more.

    Raises:
        OSError: there is none.
    """
    head, until = b"", time.monotonic() + _PATIENCE_S
    while b"\r\n\r\n" not in head:
        piece = client.recv(_HEAD_BYTES)
        head += piece
        if not piece or len(head) > _HEAD_BYTES or time.monotonic() > until:
            raise ConnectionAbortedError
    return head


def _response(status: str, text: str, *fields: str) -> bytes:
    body = f"{text}\n"
    lines = (
        f"HTTP/1.1 {status}",
        "Content-Type: text/plain",
        f"Content-Length: {len(body)}",
        "Connection: close",
    )
    return "\r\n".join((*lines, *fields, "", body)).encode()


def _listen(endpoint: Endpoint) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(endpoint.address, endpoint.port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except (OSError, UnicodeError, OverflowError) as error:
        number = getattr(error, "errno", None) or 0
        why = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or str(error)
        raise CaptureError(
            f"{endpoint}: cannot be listened on: {why}; name another port (0: any that is free) or address"
        ) from None
