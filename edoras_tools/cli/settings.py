"""``edoras.toml``: values of options that the user would repeat for every command.

Rules:

1. The file is searched in the working folder, then in its parents up to the root of the repository or
   the home folder; outside of both only in the working folder. ``EDORAS_CONFIG`` names a file instead.
2. A file from the search must belong to the user, and others must not be able to write to it: a project
   that somebody unpacked in a shared folder must not change the effect of a command.
3. Only the options in ``SETTABLE`` can be set. None of them listens, sends, confirms, overwrites or leaves
   data out.
4. The command line and environment variables take precedence over the file.
"""

from __future__ import annotations

import os
import stat
import sys
from collections.abc import Collection, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

from edoras_tools.errors import ConfigError
from edoras_tools.words import did_you_mean, listed

NAME: Final = "edoras.toml"
VARIABLE: Final = "EDORAS_CONFIG"

PATHS: Final = ("config", "msg-path", "structs")
"""Options whose values are paths, relative to the folder of the file."""
SETTABLE: Final = (
    *PATHS,
    *("distro", "port", "envelope", "extended-header", "telemetry-header", "msg-id-version", "set"),
    *("ros", "domain", "ros-option", "tolerance", "max-loss", "quiet", "verbose", "color"),
)
"""Names of the options that a file can set."""
COMMAND_LINE_ONLY: Final = (
    *("yes", "force", "output", "user", "interface", "listen", "bind", "host", "ws-port", "live", "token"),
    *("allow-origin", "allow-publish", "allow", "target", "to", "as", "enable", "unlimited"),
    *("link", "topic", "msg-id", "where", "start", "end", "count", "duration"),
)
"""Options that a reader may look for here: they send, listen, confirm, overwrite, or leave data out."""

_LARGEST: Final = 1 << 18


class SettingsFile(NamedTuple):
    """A settings file.

    Attributes:
        path: absolute path.
        values: values by option name; those for one command are in a table of its name.
        left_out: reason why it is not used; empty if it is used.
    """

    path: Path
    values: Mapping[str, Any]
    left_out: str = ""

    def check(self, commands: Collection[str]) -> None:
        """Check the names in the file.

        Args:
            commands: the names that tables can have.

        Raises:
            ConfigError: all names that are not known or cannot be set.
        """
        tables = {name: table for name, table in self.values.items() if isinstance(table, dict)}
        mistakes = [
            f"{self.path}: [{name}]: no such command; {did_you_mean(name, commands) or 'see edoras -h'}"
            for name in tables
            if name not in commands
        ]
        keys = [("", key) for key in self.values if key not in tables]
        keys += [(f"{name}.", key) for name, table in tables.items() for key in table]
        mistakes += [f"{self.path}: {where}{key}: {_why(key)}" for where, key in keys if key not in SETTABLE]
        if mistakes:
            raise ConfigError(*mistakes)

    def defaults(self, command: str, options: Mapping[str, bool]) -> dict[str, Any]:
        """Return the values for a command, by option name, with values as click's ``default_map`` has them.

        Args:
            options: names of its options, each with whether it takes several values.

        Raises:
            ConfigError: a value is a table, or a list where one value is needed.
        """
        values = {**self.values, **self.values.get(command, {})}
        return {
            name: self._value(name, values[name], many=options[name])
            for name in SETTABLE
            if name in options and name in values
        }

    def _value(self, name: str, value: Any, *, many: bool) -> Any:
        items = value if isinstance(value, list) and many else [value]
        if not all(isinstance(item, str | int | float) for item in items):
            needed = "a text or a list of texts" if many else "one value"
            raise ConfigError(f"{self.path}: {name}: {needed} is needed")
        if name in PATHS:
            items = [self.path.parent / Path(str(item)).expanduser() for item in items]
        items = [item if isinstance(item, bool) else str(item) for item in items]
        return items if many else items[0]


def in_effect() -> SettingsFile | None:
    """Return the settings file that is used."""
    file = find()
    return None if file is None or file.left_out else file


def find() -> SettingsFile | None:
    """Return the settings file for the working folder, or the one that ``EDORAS_CONFIG`` names.

    Raises:
        ConfigError: ``EDORAS_CONFIG`` names no file, or the file cannot be read.
    """
    try:
        folder = Path.cwd()
    except OSError:  # it was deleted
        return None
    return _find(folder, os.environ.get(VARIABLE, ""))


@cache
def _find(folder: Path, override: str) -> SettingsFile | None:
    """Find and read the file, once: a command that gives up its rights still knows which one it was."""
    if override:
        return _read(folder / override)
    folders = [folder, *folder.parents]
    tops = [place for place, item in enumerate(folders) if (item / ".git").exists() or item == _home()]
    for item in folders[: tops[0] + 1 if tops else 1]:
        if (item / NAME).is_file():
            left_out = _not_own(item / NAME)
            return SettingsFile(item / NAME, {}, left_out) if left_out else _read(item / NAME)
    return None


def _home() -> Path | None:
    try:
        return Path.home()
    except RuntimeError:  # a user without a home
        return None


def _not_own(path: Path) -> str:
    """Return why a file is not the user's own, with sudo the calling user's; empty where it is."""
    status, user = path.stat(), os.geteuid()
    users = {user, int(os.environ.get("SUDO_UID") or 0)} if user == 0 else {user}
    if status.st_uid not in users:
        return f"it belongs to another user; {VARIABLE}={path} uses it all the same"
    return "every user can write to it; change that with chmod o-w" if status.st_mode & stat.S_IWOTH else ""


def _read(path: Path) -> SettingsFile:
    if sys.version_info >= (3, 11):
        import tomllib
    else:
        import tomli as tomllib

    hint = f"{VARIABLE} names a file like {NAME}" if path.name != NAME else "correct it"
    try:
        if path.is_dir():
            raise ConfigError(f"{path}: a folder; {hint}")
        with path.open("rb") as file:
            data = file.read(_LARGEST + 1)
        if len(data) > _LARGEST:
            raise ConfigError(f"{path}: larger than {_LARGEST >> 10} KiB; {hint}")
        return SettingsFile(path, tomllib.loads(data.decode("utf-8-sig")))
    except (OSError, ValueError, RecursionError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{path}: {why}; {hint}") from None


def _why(key: str) -> str:
    if key in COMMAND_LINE_ONLY:
        return "only for the command line; a file cannot send, listen, confirm, overwrite or leave data out"
    return f"not known here; {did_you_mean(key, SETTABLE) or f'known are {listed(sorted(SETTABLE), 99)}'}"
