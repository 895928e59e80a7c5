"""The server's own page and its JSON, and the web pages that may connect.

The page is one HTML file that shows the link; it reads the JSON once a second. A browser lets any page
connect to this machine, and sends its origin.
"""

from __future__ import annotations

import json
import math
import re
from base64 import b64encode
from collections.abc import Callable, Mapping
from fnmatch import fnmatchcase
from functools import cache
from hashlib import sha256
from http import HTTPStatus
from importlib.resources import files
from ipaddress import ip_address
from typing import Any, Final, NamedTuple
from urllib.parse import urlsplit

import msgspec

from edoras_tools.errors import ConfigError

_STATE: Final = "/live.json"
_SHARED_S: Final = 0.25
_FLOWING_S: Final = 1.0
"""Lifetime of the JSON while traffic flows, s: the next batch replaces it earlier."""
_SOONEST_S: Final = 0.6
_BEHIND_S: Final = 0.05
"""Time from a change to the browsers' next request, s."""
_BLOCK: Final = r"<{0}>(.*?)</{0}>"
_REQUEST: Final = re.compile(rb"GET (/[!-~]*) HTTP/1\.1\r\n((?:[!#-'*+.0-9A-Z^-z|~-]+:[ -~]*\r\n)*)\r\n")
_NOT_PLAIN: Final = {b"upgrade", b"content-length", b"transfer-encoding", b"expect"}


class HttpAnswer(NamedTuple):
    """An HTTP answer: status, headers, body."""

    status: int
    headers: Mapping[str, str]
    body: bytes

    def whole(self, connection: str) -> bytes:
        """Return the answer as bytes; ``connection``: ``close`` or ``keep-alive``."""
        head = [f"{name}: {value}" for name, value in {**self.headers, "Connection": connection}.items()]
        first = f"HTTP/1.1 {self.status} {HTTPStatus(self.status).phrase}"
        return "\r\n".join([first, *head, "", ""]).encode() + self.body


def plain_request(data: bytes) -> tuple[str, str, str | None] | None:
    """Parse a browser's repeated request for a page: path with query, host, origin or None.

    The result is None if it is anything else, incomplete, or if its connection is not kept.
    """
    match = _REQUEST.fullmatch(data)
    lines = [line.partition(b":") for line in match[2].split(b"\r\n")[:-1]] if match else []
    fields = {name.lower(): value.strip().decode() for name, _, value in lines}
    again = fields.get(b"connection", "").lower() == "keep-alive"
    if match is None or not again or len(fields) < len(lines) or _NOT_PLAIN & fields.keys():
        return None
    return match[1].decode(), fields.get(b"host", ""), fields.get(b"origin") or None


class SharedState:
    """The JSON of a state, made once for all browsers that ask before it changes."""

    def __init__(self, state: Callable[[], Mapping[str, Any]], clock: Callable[[], float]) -> None:
        self._state, self._clock = state, clock
        self._text, self._until = "", -math.inf
        self._changes = self._shown = 0
        self._changed = self._every_s = 0.0

    def changed(self) -> None:
        """Record that the state has changed; call it from a single thread."""
        now = self._clock()
        self._changed, self._every_s = now, now - self._changed
        self._changes += 1

    def next_ms(self) -> int:
        """Return the time until a browser's next request, ms: about a second, soon after the next change.

        So all browsers ask together, which costs less than one by one, and show the latest state.
        """
        since_s = self._clock() - self._changed
        if not 0 < self._every_s < _FLOWING_S + _BEHIND_S or since_s > 2 * self._every_s:
            return 1000
        times = math.ceil((_SOONEST_S + since_s - _BEHIND_S) / self._every_s)
        return round(1000 * (times * self._every_s + _BEHIND_S - since_s))

    def text(self) -> str:
        """Return the state as JSON; call it from a single thread."""
        changes, now = self._changes, self._clock()
        if now >= self._until or changes != self._shown:
            state = self._state()
            silent_s = (state.get("link") or {}).get("silent_s")
            flows = silent_s is not None and silent_s < _FLOWING_S
            self._text, self._shown = json.dumps(state), changes
            self._until = now + (_FLOWING_S if flows else _SHARED_S)
        return self._text


def answer(path: str, state: SharedState) -> HttpAnswer:
    """Return the answer to a request.

    Args:
        path: path without the query.
        state: state that is shown.
    """
    if path in {"/", "/index.html"}:
        text, policy = _page()
        return _answer(200, "text/html", text, {"Content-Security-Policy": policy})
    if path == _STATE:
        return _answer(200, "application/json", state.text(), {"Next-Ms": str(state.next_ms())})
    return _answer(404, "text/plain", f"There is / for people and {_STATE} for programs.\n", {})


def _answer(status: int, kind: str, text: str, headers: Mapping[str, str]) -> HttpAnswer:
    body = text.encode()
    always = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",  # the address may contain the token
        "X-Content-Type-Options": "nosniff",
    }
    return HttpAnswer(status, {**always, **headers}, body)


@cache
def _page() -> tuple[str, str]:
    """Return the page, and its policy: a browser may load only its own content and its JSON."""
    text = files("edoras_tools.addons.foxglove.server").joinpath("page.html").read_text("utf-8")
    hashes = []
    for name in ("style", "script"):
        match = re.search(_BLOCK.format(name), text, re.DOTALL)
        assert match is not None, "the page has both"
        hashes.append(b64encode(sha256(match[1].encode()).digest()).decode())
    style, script = hashes
    allowed = f"style-src 'sha256-{style}'; script-src 'sha256-{script}'; connect-src 'self'; img-src data:"
    return text, f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"


_FOXGLOVE: Final = ("https://*.foxglove.dev", "file://")
"""Foxglove in a browser, and desktop apps; for a local file a browser sends ``null``."""
_ORIGIN: Final = re.compile(r"null|[a-z][a-z0-9+.-]*://[^\s/@?#\\]*")


class OriginCheck(msgspec.Struct, frozen=True):
    """The web pages that may connect: Foxglove's, those from this machine, and pages of further origins.

    Programs send no origin, and need none.

    Attributes:
        origins: further origins (RFC 6454), e.g. ``https://viz.example.org``; ``*`` allows all.
        tell: called with a note when a page or another client was refused, on any thread.

    Raises:
        ConfigError: a text is not an origin.
    """

    origins: tuple[str, ...] = ()
    tell: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        """Check the origins."""
        for origin in self.origins:
            if origin != "*" and not _ORIGIN.fullmatch(origin.lower()):
                raise ConfigError(f"{origin!r} is not an origin; write it like https://viz.example.org")

    def admits(self, origin: str) -> bool:
        """Return whether a page of this origin may connect; the origin as the browser sends it."""
        origin = origin.lower()
        if "*" in self.origins:
            return True
        if not _ORIGIN.fullmatch(origin):
            return False
        allowed = (*_FOXGLOVE, *map(str.lower, self.origins))
        return any(origin == item or fnmatchcase(origin, item) for item in allowed) or _is_here(origin)

    def admits_host(self, host: str) -> bool:
        """Return whether our own page may be opened with this host, as the browser sends it (``Host``).

        An address is allowed, and a name whose pages may connect. An attacker can make any other name
        resolve to this machine, so that the browser takes our page for the attacker's (DNS rebinding).
        """
        return self.admits(f"http://{host}") or _is_address(host)


def _is_address(host: str) -> bool:
    try:
        return bool(ip_address(urlsplit(f"http://{host}").hostname or ""))
    except ValueError:
        return False


def _is_here(origin: str) -> bool:
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
        if parts.scheme not in {"http", "https"}:
            return False
        return host == "localhost" or host.endswith(".localhost") or ip_address(host).is_loopback
    except ValueError:
        return False
