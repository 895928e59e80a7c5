"""The rules: a function each that goes through a case and yields verdicts, which get its name.

They are asked in the order in which they stand in these modules: who quotes others comes behind them.
``docs/rules`` has a section for each.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools import doors
from edoras_tools.diagnosis.rules import (
    capture,
    commands,
    flight_software,
    gaps,
    messages,
    network,
    output,
    pipes,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

    Rule = Callable[[Case], Iterator[Verdict]]

_MODULES: Final = capture, pipes, commands, messages, network, output, gaps, flight_software
RULES: Final[dict[str, Rule]] = {
    name: item
    for module in _MODULES
    for name, item in vars(module).items()
    if name[0] != "_" and getattr(item, "__annotations__", {}).get("return") == "Iterator[Verdict]"
}
"""Those of the core, by the name that their verdicts carry: what is public there and yields verdicts."""


def of_addons() -> dict[str, Rule]:
    """Return the rules of the add-ons that are here; those are about what links saw themselves."""
    return {name: item.load() for name, item in doors.shipped("rules").items() if not item.absent}


def shipped_rules() -> dict[str, Rule]:
    """Return the rules of the core and of the add-ons that are here."""
    return RULES | of_addons()


def others() -> list[Rule]:
    """Return the rules that are not about the rows of a case: a capture may hold nothing else."""
    return [capture.not_examined, capture.not_cfs, *of_addons().values()]


def rules() -> dict[str, Rule]:
    """Return all rules, by the name that their verdicts carry: those that installed packages add come last.

    Raises:
        ConfigError: a package's rule cannot be loaded, or its name is taken.
    """
    result = shipped_rules()
    for item in doors.installed("rules"):
        if item.name in result:
            raise item.error("another rule has this name; uninstall one of them")
        result[item.name] = item.load()
    return result


SINGLE: Final = frozenset(
    {
        *("struct_overrun", "ci_cut", "ground_bridge_buffer", "flight_bridge_length", "bad_command"),
        *("no_subscriber", "bad_network_message", "wrong_ident", "wrong_protocol_version", "unknown_peer"),
        *("wrong_type", "host_drops", "not_cfs"),
    }
)
"""Rules about messages that come to nothing by what they are; asked first: the balance has their figures."""
