"""The keys that edoras-tools adds to a bridge's file: rates and quality of service.

They are below a topic's own key, or below ``edoras`` for all topics. The public bridges declare every
parameter of the file and look theirs up by name, so they ignore these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.mission.fields import Fields, suggestion
from edoras_tools.mission.model import Handling

if TYPE_CHECKING:
    from collections.abc import Sequence


HANDLING_GROUP: Final = "edoras"
"""The group of the keys for all topics of a bridge, and for the bridge itself."""
TOPIC_KEYS: Final = ("max_rate", "keep", "to_limit")
BRIDGE_KEYS: Final = ("max_rate", "keep", "max_rate_total", "max_size")
_QOS: Final = ("reliability", "durability", "depth")
_MOST: Final = 1 << 20
_TO_MOST: Final = 0xFF
"""Telemetry Output keeps a limit in eight bits."""


def read_handling(fields: Fields, group: str, defaults: Handling) -> Handling:
    """Read the handling of topics from a group; mistakes go to the report.

    Args:
        group: a topic's key, or ``HANDLING_GROUP``.
    """
    keep: Any = fields.word(f"{group}.keep", ("latest", "first"))
    reliability = fields.word(f"{group}.qos.reliability", ("reliable", "best_effort"))
    durability = fields.word(f"{group}.qos.durability", ("volatile", "transient_local"))
    warn_of_unknown(fields, f"{group}.qos", _QOS)
    return Handling(
        max_rate=fields.rate(f"{group}.max_rate") or defaults.max_rate,
        keep=keep or defaults.keep,
        reliable=reliability == "reliable" if reliability else defaults.reliable,
        transient_local=durability == "transient_local" if durability else defaults.transient_local,
        depth=fields.count(f"{group}.qos.depth", _MOST) or defaults.depth,
        to_limit=fields.count(f"{group}.to_limit", _TO_MOST) if group != HANDLING_GROUP else None,
    )


def warn_of_unknown(fields: Fields, group: str, known: Sequence[str]) -> None:
    """Warn of unknown keys in a group."""
    for name in fields.node.children(group):
        if name not in known:
            words = ", ".join(known)
            fields.warn(f"{group}.{name}", f"ignored; {suggestion(name, known)}read are {words}")
