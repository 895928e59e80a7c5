"""Which web pages may connect: a browser lets any page speak to this machine, and says where it is from."""

from __future__ import annotations

import re
from dataclasses import dataclass
from fnmatch import fnmatchcase
from ipaddress import ip_address
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

_FOXGLOVE: Final = ("https://*.foxglove.dev", "file://")
"""Foxglove in a browser, and desktop apps; of a file that it opens itself a browser says ``null``."""
_ORIGIN: Final = re.compile(r"null|[a-z][a-z0-9+.-]*://[^\s/@?#\\]*")


@dataclass(frozen=True, slots=True)
class Guard:
    """Lets in programs, which name no origin, Foxglove, and the pages that this machine serves.

    Attributes:
        origins: further origins (RFC 6454), as ``https://viz.example.org``; ``*`` stands for anything.
        tell: told of a page that was kept out, on any thread.

    Raises:
        ConfigError: one is no origin.
    """

    origins: tuple[str, ...] = ()
    tell: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        """Check the origins."""
        for origin in self.origins:
            if origin != "*" and not _ORIGIN.fullmatch(origin.lower()):
                raise ConfigError(f"{origin!r} is no origin; name it as https://viz.example.org")

    def admits(self, origin: str) -> bool:
        """Tell whether a page of an origin may connect, as its browser writes it."""
        origin = origin.lower()
        if "*" in self.origins:
            return True
        if not _ORIGIN.fullmatch(origin):
            return False
        allowed = (*_FOXGLOVE, *map(str.lower, self.origins))
        return any(origin == item or fnmatchcase(origin, item) for item in allowed) or _is_here(origin)


def _is_here(origin: str) -> bool:
    try:
        parts = urlsplit(origin)
        host = parts.hostname or ""
        if parts.scheme not in {"http", "https"}:
            return False
        return host == "localhost" or host.endswith(".localhost") or ip_address(host).is_loopback
    except ValueError:
        return False
