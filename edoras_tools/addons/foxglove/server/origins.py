"""The web pages that may connect: a browser lets any page connect to this machine, and sends its origin."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

import msgspec

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

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
