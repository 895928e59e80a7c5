"""The server's own page: one HTML file that shows the link, and the JSON that it reads once a second."""

from __future__ import annotations

import json
import math
import re
from base64 import b64encode
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

_STATE: Final = "/live.json"
_SHARED_S: Final = 0.5
_BLOCK: Final = r"<{0}>(.*?)</{0}>"


class HttpAnswer(NamedTuple):
    """An HTTP answer: status, headers, body."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class SharedState:
    """The JSON of a state, made once for all browsers that ask within half a second; for one thread."""

    def __init__(self, state: Callable[[], Mapping[str, object]], clock: Callable[[], float]) -> None:
        self._state, self._clock = state, clock
        self._text, self._until = "", -math.inf

    def text(self) -> str:
        """Return the state as JSON."""
        if self._clock() >= self._until:
            self._text, self._until = json.dumps(self._state()), self._clock() + _SHARED_S
        return self._text


def answer(path: str, state: Callable[[], str]) -> HttpAnswer:
    """Return the answer to a request.

    Args:
        path: without the query.
        state: returns what is shown, as JSON.
    """
    if path in {"/", "/index.html"}:
        text, policy = _page()
        return _answer(200, "text/html", text, {"Content-Security-Policy": policy})
    if path == _STATE:
        return _answer(200, "application/json", state(), {})
    return _answer(404, "text/plain", f"There is / for people and {_STATE} for programs.\n", {})


def _answer(status: int, kind: str, text: str, headers: Mapping[str, str]) -> HttpAnswer:
    body = text.encode()
    always = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Connection": "close",
        "Referrer-Policy": "no-referrer",  # the address may have the token
        "X-Content-Type-Options": "nosniff",
    }
    return HttpAnswer(status, {**always, **headers}, body)


@cache
def _page() -> tuple[str, str]:
    """Return the page, and the policy that lets a browser load nothing but what is in it and its JSON."""
    text = files("edoras_tools.addons.foxglove.server").joinpath("page.html").read_text("utf-8")
    hashes = []
    for name in ("style", "script"):
        match = re.search(_BLOCK.format(name), text, re.DOTALL)
        assert match is not None, "the page has both"
        hashes.append(b64encode(sha256(match[1].encode()).digest()).decode())
    style, script = hashes
    allowed = f"style-src 'sha256-{style}'; script-src 'sha256-{script}'; connect-src 'self'; img-src data:"
    return text, f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
