"""The standard messages of every ROS 2 distribution, as rosbags knows them.

They are kept as text: rosbags builds a class for each, which takes longer than any other step of a command's
start. ``write`` makes the text anew from the rosbags that is installed.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any, Final

FILE: Final = Path(__file__).parent / "definitions" / "standard.json"
"""``distros``, oldest first, and ``types``: name -> {distribution: ``ros2msg`` text}. A text holds until a
newer distribution has another; null ends it."""


def distros() -> list[str]:
    """Return the names of the distributions, oldest first."""
    return list(_table()["distros"])


def standard(distro: str) -> dict[str, str]:
    """Return the definitions of a distribution, ``ros2msg`` text by type name.

    Raises:
        ValueError: there is no such distribution.
    """
    table = _table()
    until = table["distros"].index(distro) + 1
    found = {}
    for name, texts in table["types"].items():
        for known in table["distros"][:until]:
            if known in texts:
                found[name] = texts[known]
    return {name: text for name, text in found.items() if text is not None}


@cache
def _table() -> dict[str, Any]:
    table: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return table


def collect() -> dict[str, Any]:
    """Return what ``FILE`` should hold, from the rosbags that is installed."""
    from rosbags.typesys import Stores, get_typestore

    from edoras_tools.ros.library import converted

    stores = [store for store in Stores if store.value.startswith("ros2_")]
    types: dict[str, dict[str, str | None]] = {}
    now: dict[str, str | None] = {}
    for store in stores:
        distro = store.value.removeprefix("ros2_")
        fields = get_typestore(store).fielddefs
        texts = {name: converted(name, fields).text for name in fields}
        for name in sorted({*texts, *now}):
            if name not in now or now[name] != texts.get(name):
                now[name] = types.setdefault(name, {})[distro] = texts.get(name)
    return {
        "distros": [store.value.removeprefix("ros2_") for store in stores],
        "types": dict(sorted(types.items())),
    }


def write() -> None:
    """Write ``FILE``."""
    FILE.write_text(json.dumps(collect(), indent=1) + "\n", encoding="utf-8")
