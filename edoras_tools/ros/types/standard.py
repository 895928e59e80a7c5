"""The standard messages of every ROS 2 distribution, as rosbags knows them.

They are kept as text: rosbags builds a class for each of them, which takes longer than any other step of a
command's start. ``python tests/ros/types/test_standard.py`` writes the text again from the installed rosbags.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.ros.types.schema import PLACEHOLDER, Constant, Definition, MessageField, Shape

if TYPE_CHECKING:
    from rosbags.interfaces.typing import FieldDesc, Typesdict

FILE: Final = Path(__file__).parent / "definitions" / "standard.json"
"""File with ``distros``, oldest first, and ``types``: name -> {distribution: ``ros2msg`` text}. A text
applies until a newer distribution has another one; null ends it."""
_STANDARD_DEFAULTS: Final = {
    ("geometry_msgs/msg/Quaternion", "w"): (1.0, ""),
    ("sensor_msgs/msg/NavSatStatus", "status"): (-2, "STATUS_UNKNOWN"),
}
"""Defaults that are not zero, since rosbags keeps none, for the standard packages: (type, field) to (value,
constant). Each applies only if the definition has the constant, if one is named."""


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
    texts_by_name = {}
    for name, texts in table["types"].items():
        for distro_ in table["distros"][:until]:
            if distro_ in texts:
                texts_by_name[name] = texts[distro_]
    return {name: text for name, text in texts_by_name.items() if text is not None}


@cache
def _table() -> dict[str, Any]:
    return json.loads(FILE.read_text(encoding="utf-8"))


def converted(name: str, types: Typesdict) -> Definition:
    """Return a definition that rosbags holds as one of ours."""
    constants, fields = types[name]
    constants_named = {"", *(item for item, _, _ in constants)}
    defaults = {
        field: value
        for (owner, field), (value, constant) in _STANDARD_DEFAULTS.items()
        if owner == name and constant in constants_named
    }
    return Definition(
        name,
        tuple(_field(item, description, defaults) for item, description in fields if item != PLACEHOLDER),
        tuple(Constant(item, kind, value) for item, kind, value in constants),
    )


def _field(name: str, description: FieldDesc, defaults: dict[str, Any]) -> MessageField:
    """Convert rosbags' description of a field, nested pairs of a node kind and its arguments, to ours."""
    from rosbags.interfaces import Nodetype

    kind: Any
    arguments: Any
    kind, arguments = description
    shape, size = Shape.SCALAR, 0
    if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        shape = Shape.ARRAY if kind == Nodetype.ARRAY else Shape.SEQUENCE
        (kind, arguments), size = arguments
    base, bound = arguments if kind == Nodetype.BASE else (arguments, 0)
    return MessageField(name, base, bound, shape, size, defaults.get(name))
