"""The one way to what is not of the core: add-ons that ship, and packages that other people install.

Add-ons stand in the table of :mod:`edoras_tools.addons`; a package declares its additions as entry points of
the group ``edoras.KIND``. Both become an :class:`Addition`, and nothing of either is imported before it is
used. Packages are searched only if the core and its add-ons do not have what is needed: a search of all of
them takes 2 ms.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.addons import Addon

KINDS: Final = {
    "links": "link",
    "commands": "command",
    "formats": "format",
    "middleware": "middleware",
    "rules": "rule",
    "databases": "database",
    "parts": "part",
}
"""Kinds of additions, and the noun for one of each. Only add-ons have ``parts``: a command of the core uses a
part for an option, as ``sniff --tui``, or another add-on uses it."""
_ADDONS: Final = "edoras_tools.addons"


class Addition(msgspec.Struct, frozen=True):
    """One thing that an add-on or an installed package adds.

    Attributes:
        kind: key of ``KINDS``.
        name: name for users.
        place: place of the object, as ``module:name``.
        package: distribution that it comes from; empty for an add-on.
    """

    kind: str
    name: str
    place: str
    package: str = ""

    @property
    def absent(self) -> bool:
        """Whether it belongs to an add-on whose folder was deleted."""
        if self.package:
            return False
        folder = find_spec(f"{_ADDONS}.{self._folder}")
        return folder is None or folder.origin is None  # a folder with nothing but caches is no package

    def load(self) -> Any:
        """Import the object and return it.

        Raises:
            ConfigError: its folder was deleted, or a package's object cannot be imported.
            ImportError: an add-on needs a library that is not installed.
        """
        if not self.package:
            if self.absent:
                raise self.error("it is left out of this installation; install edoras-tools whole")
            return imported(self.place)
        try:
            return imported(self.place)
        except Exception as error:  # an import of another package may raise anything
            raise self.error(f"cannot be loaded: {error}") from error

    def error(self, why: str) -> ConfigError:
        """Return the error that it cannot be used, in one line with its name and where it comes from."""
        subject = f"{KINDS[self.kind]} {self.name!r} of"
        if self.package:
            return ConfigError(f"{subject} the installed package {self.package}: {why}")
        return ConfigError(f"{subject} the add-on {self._folder}: {why}")

    @property
    def _folder(self) -> str:
        return re.split(r"[.:]", self.place)[2]


def imported(place: str) -> Any:
    """Import and return the object of ``module:name``; the module itself if no name is given."""
    module, _, name = place.partition(":")
    target = import_module(module)
    return attrgetter(name)(target) if name else target


def later(package: str, **homes: str) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package that imports each of its names when it is first used.

    Args:
        package: name of the package.
        homes: names that a module of the package holds, separated by spaces, by the name of the module.
    """
    places = {name: f"{package}.{module}:{name}" for module, names in homes.items() for name in names.split()}

    def attribute(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return imported(places[name])

    return attribute


def table() -> tuple[Addon, ...]:
    """Return the table of add-ons, including those whose folder was deleted."""
    from edoras_tools.addons import ADDONS

    return ADDONS


def shipped(kind: str) -> dict[str, Addition]:
    """Return the additions of a kind by add-ons, by name, including those whose folder was deleted."""
    return {
        name: Addition(kind, name, f"{_ADDONS}.{row.folder}.{place}".replace(".:", ":"))
        for row in table()
        for name, place in row.places(kind).items()
    }


def addon_ports() -> dict[str, tuple[int, ...]]:
    """Return the usual UDP ports of the links of add-ons that are there, by label."""
    from edoras_tools.addons import LINK_PORTS

    links = shipped("links")
    return {label: ports for label, ports in LINK_PORTS.items() if label in links and not links[label].absent}


def installed(kind: str) -> list[Addition]:
    """Return the additions of a kind by installed packages, sorted by name."""
    if kind not in _kinds(tuple(sys.path)):
        return []
    from importlib.metadata import entry_points  # 30 ms, most of it to import the email parser

    return [
        Addition(kind, item.name, item.value, item.dist.name if item.dist else item.value)
        for item in sorted(entry_points(group=f"edoras.{kind}"), key=lambda item: item.name)
    ]


def find(kind: str, name: str) -> Addition | None:
    """Return the addition with a name, an add-on's before a package's; None if there is none."""
    return shipped(kind).get(name) or next((item for item in installed(kind) if item.name == name), None)


def part(name: str) -> Any:
    """Import and return a part of an add-on, which a command of the core or another add-on needs.

    Raises:
        ConfigError: the add-on's folder was deleted.
        ImportError: it needs a library that is not installed.
    """
    return shipped("parts")[name].load()


@cache
def _kinds(paths: tuple[str, ...]) -> frozenset[str]:
    """Return the kinds that packages in these folders may add; a file, such as a zip, may add all of them."""
    kinds: set[str] = set()
    for path in map(Path, paths):
        if not path.is_dir():
            kinds |= KINDS.keys() if path.exists() else set()
            continue
        try:
            for folder in path.iterdir():
                if folder.name.endswith("-info") and (file := folder / "entry_points.txt").is_file():
                    text = file.read_bytes()
                    kinds |= {kind for kind in KINDS if f"edoras.{kind}".encode() in text}
        except OSError:
            return frozenset(KINDS)
    return frozenset(kinds)
