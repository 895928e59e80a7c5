"""The configuration of a Zenoh session: as in rmw_zenoh, with the user's changes."""

from __future__ import annotations

import json
import os
import re
from typing import TYPE_CHECKING, Final

import zenoh

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import unknown_options

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping


ROUTER: Final = "tcp/localhost:7447"
"""Where rmw_zenoh's nodes look for a router."""
_OPTIONS: Final = ("router", "mode", "listen", "config", "type_hash")
_CONFIG_FILE: Final = "ZENOH_SESSION_CONFIG_URI"
_OVERRIDES: Final = "ZENOH_CONFIG_OVERRIDE"
"""The two environment variables that rmw_zenoh reads."""
_DEFAULTS: Final = {
    "mode": "peer",
    "connect/endpoints": [ROUTER],
    "listen/endpoints": ["tcp/localhost:0"],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": True,
    "timestamping/enabled": True,  # a cache needs it
    "queries_default_timeout": 600_000,
    "transport/shared_memory/enabled": False,
}
"""What rmw_zenoh's session configuration says differently from Zenoh's own."""
_PLACE: Final = re.compile(r"\s*at /[^\s\]\"]+")
_INNER: Final = re.compile(r'(?:msg: |Str\()"(.*?)"')
_KEYS: Final = {"router": "connect/endpoints", "listen": "listen/endpoints", "mode": "mode"}
_MODES: Final = ("peer", "client")
_PORT: Final = re.compile(r":[1-9]\d*(?=[?#]|$)")


def session_config(options: Mapping[str, str]) -> zenoh.Config:
    """Return a session's configuration.

    The later wins: rmw_zenoh's defaults, or the file of ``config`` or ``ZENOH_SESSION_CONFIG_URI`` in their
    place; ``ZENOH_CONFIG_OVERRIDE``; the options.

    Raises:
        ConfigError: an option, a file or a value that cannot be honoured.
    """
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


def listen_beside(config: zenoh.Config, used: Collection[str]) -> list[str]:
    """Have a session leave the places where others of this process listen, and connect to them.

    There it listens at a port that the system chooses; gossip tells the other peers about it.

    Args:
        config: changed in place.
        used: places as ``listen`` names them.

    Returns:
        the places with a port of their own that this session takes itself.
    """
    if _mode(config) == "client":
        return []  # listens nowhere
    places = _places(config, "listen")
    if shared := [place for place in places if place in used]:
        beside = [_PORT.sub(":0", place) if place in used else place for place in places]
        config.insert_json5("listen/endpoints", json.dumps(beside))
        config.insert_json5("connect/endpoints", json.dumps([*_places(config, "connect"), *shared]))
    return [place for place in places if place not in used and _PORT.search(place)]


def _places(config: zenoh.Config, group: str) -> list[str]:
    """Return the endpoints of ``listen`` or ``connect``: one list, or one a mode."""
    places = json.loads(config.get_json(f"{group}/endpoints"))
    if isinstance(places, dict):
        places = places.get(_mode(config))
    return [str(item) for item in places or []]


def _mode(config: zenoh.Config) -> str:
    return str(json.loads(config.get_json("mode")) or _MODES[0])


def check_options(options: Mapping[str, str]) -> None:
    """Refuse options that this side does not have.

    Raises:
        ConfigError: all mistakes at once.
    """
    mistakes = unknown_options("zenoh", options, _OPTIONS)
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
    """Yield the origin of a setting, its key, and its value in JSON5."""
    if defaults:
        for key, value in _DEFAULTS.items():
            yield "zenoh", key, json.dumps(value)
    for pair in filter(None, os.environ.get(_OVERRIDES, "").split(";")):
        key, _, text = pair.partition("=")
        yield _OVERRIDES, key.strip(), text
    for name, key in _KEYS.items():
        if name in options:
            words = options[name]
            places = [item.strip() for item in words.split(",") if item.strip()]
            yield f"zenoh: {name}", key, json.dumps(words if name == "mode" else places)
