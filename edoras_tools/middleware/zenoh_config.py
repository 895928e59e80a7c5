"""How a Zenoh session is opened: as rmw_zenoh opens its own, but for what the user says otherwise."""

from __future__ import annotations

import json
import os
import re
from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import unknown_options

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import zenoh

ROUTER: Final = "tcp/localhost:7447"
"""Where rmw_zenoh's nodes look for a router."""
OPTIONS: Final = ("router", "mode", "listen", "config", "type_hash")
_CONFIG_FILE: Final = "ZENOH_SESSION_CONFIG_URI"
_OVERRIDES: Final = "ZENOH_CONFIG_OVERRIDE"
"""The two variables of the environment that rmw_zenoh obeys."""
_DEFAULTS: Final = {
    "mode": "peer",
    "connect/endpoints": [ROUTER],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "timestamping/enabled": True,  # a cache asks for it
    "queries_default_timeout": 600_000,
    "transport/shared_memory/enabled": False,
}
"""What rmw_zenoh's session configuration says differently from Zenoh's own."""
_PLACE: Final = re.compile(r"\s*at /[^\s\]\"]+")
_INNER: Final = re.compile(r'(?:msg: |Str\()"(.*?)"')
_KEYS: Final = {"router": "connect/endpoints", "listen": "listen/endpoints", "mode": "mode"}
_MODES: Final = ("peer", "client")


def session_config(options: Mapping[str, str]) -> zenoh.Config:
    """Return a session's configuration.

    The later wins: rmw_zenoh's defaults, or the file of ``config`` or ``ZENOH_SESSION_CONFIG_URI`` in their
    place; ``ZENOH_CONFIG_OVERRIDE``; the options.

    Raises:
        ConfigError: an option, a file or a value that cannot be honoured.
    """
    import zenoh

    check_options(options)
    file = options.get("config") or os.environ.get(_CONFIG_FILE)
    try:
        config = zenoh.Config.from_file(file) if file else zenoh.Config()
    except zenoh.ZError as error:
        raise ConfigError(f"{file}: no configuration of a Zenoh session: {reason(error)}") from error
    for source, key, value in _settings(options, defaults=not file):
        try:
            config.insert_json5(key, value)
        except zenoh.ZError as error:
            raise ConfigError(f"{source}: {key} cannot be {value}: {reason(error)}") from error
    return config


def check_options(options: Mapping[str, str]) -> None:
    """Refuse options that this side does not have.

    Raises:
        ConfigError: all mistakes at once.
    """
    mistakes = unknown_options("zenoh", options, OPTIONS)
    mode = options.get("mode", _MODES[0])
    if mode not in _MODES:
        mistakes.append(f"zenoh: mode {mode!r} does not exist; write {' or '.join(_MODES)}")
    if mistakes:
        raise ConfigError(*mistakes)


def reason(error: Exception) -> str:
    """Return Zenoh's own words for a failure in one line, without the places of its source files."""
    text = _PLACE.sub("", str(error))
    inner = _INNER.search(text)
    return (inner[1] if inner else text).strip(" .!")


def _settings(options: Mapping[str, str], *, defaults: bool) -> Iterator[tuple[str, str, str]]:
    """Yield who sets a key, the key, and the value in JSON5."""
    if defaults:
        for key, value in _DEFAULTS.items():
            yield "zenoh", key, json.dumps(value)
    for pair in filter(None, os.environ.get(_OVERRIDES, "").split(";")):
        key, _, text = pair.partition("=")
        yield _OVERRIDES, key.strip(), text
    for name, key in _KEYS.items():
        if name in options:
            given = options[name]
            places = [item.strip() for item in given.split(",") if item.strip()]
            yield f"zenoh: {name}", key, json.dumps(given if name == "mode" else places)
