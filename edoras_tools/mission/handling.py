"""The keys of ours in a bridge's file: rates, quality of service.

They stand below a topic's own key, or for all topics below ``edoras``. The public bridges declare whatever
parameters the file holds and look theirs up by name, so that these are passed over.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.mission.fields import suggestion
from edoras_tools.mission.model import Handling

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.mission.fields import Fields

GROUP: Final = "edoras"
"""What holds for all topics of a bridge, and for the bridge itself, stands below this name."""
TOPIC_KEYS: Final = ("max_rate", "keep", "to_limit")
BRIDGE_KEYS: Final = ("max_rate", "keep", "max_rate_total", "max_size")
_QOS: Final = ("reliability", "durability", "depth")
_MOST: Final = 1 << 20
_TO_MOST: Final = 0xFF
"""Telemetry Output keeps a limit in eight bits."""


def read_handling(fields: Fields, group: str, defaults: Handling) -> Handling:
    """Return what a group says of how to treat topics, mistakes to the report.

    Args:
        fields: the node.
        group: a topic's key, or ``GROUP``.
        defaults: hold where it says nothing.
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
        to_limit=fields.count(f"{group}.to_limit", _TO_MOST) if group != GROUP else None,
    )


def warn_of_unknown(fields: Fields, group: str, known: Sequence[str]) -> None:
    """Warn of the keys of a group that nobody reads."""
    for name in fields.node.children(group):
        if name not in known:
            words = ", ".join(known)
            fields.warn(f"{group}.{name}", f"ignored; {suggestion(name, known)}read are {words}")
