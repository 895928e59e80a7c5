"""Constants of cFS from the command line."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.cfs.profile import SimProfile, constant_names
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.cfe import message_limits, network_peers
from edoras_tools.words import did_you_mean

if TYPE_CHECKING:
    from collections.abc import Sequence

_TABLES: Final = {"to_limits": message_limits, "sbn_table": network_peers}
"""Constants that are read from a table image."""


def read_constants(constants: Sequence[str]) -> dict[str, Any]:
    """Return constants by name.

    Args:
        constants: ``NAME=VALUE`` each, whole numbers; ``to_limits=FILE`` and ``sbn_table=FILE``: images of
            the tables of Telemetry Output and of SBN.

    Raises:
        ConfigError: there is no such constant, or it cannot have that value.
        CaptureError: the table image cannot be read.
    """
    names, changes = constant_names(), dict[str, Any]()
    for text in constants:
        name, _, value = text.partition("=")
        if name in _TABLES:
            changes[name] = _TABLES[name](Path(value))
            continue
        if name not in names:
            hint = did_you_mean(name, sorted({*names, *_TABLES}), 1)
            hint = hint or f"there are {', '.join(sorted(names))}"
            raise ConfigError(f"constant {name!r} is not known; {hint}")
        try:
            changes[name] = int(value, 0)
        except ValueError:
            raise ConfigError(f"constant {text!r}: {value!r} is not a whole number; write {name}=8") from None
    SimProfile().stating(changes)
    return changes
