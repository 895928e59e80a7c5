"""Faults of a byte stream: the time when received bytes may leave. Time is an argument.

TCP delivers every byte, in order, or ends. So a stream can be late, slow, stalled or cut; but no byte can be
lost, repeated or overtaken, and rules for that are refused.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from edoras_tools.errors import ConfigError
from edoras_tools.sessions.faults.rules import Rule, RuleScope
from edoras_tools.units import SECOND

if TYPE_CHECKING:
    from collections.abc import Sequence


STREAM_KINDS: Final = ("delay", "bandwidth", "silence")
"""The kinds of faults that a stream can have; ``silence`` stalls it."""


class StreamFaults:
    """Determines when the bytes of one direction of a connection leave.

    Args:
        rules: faults; those of the other direction are ignored.
        to_cfs: the direction.

    Attributes:
        struck: number of times that each rule made bytes wait.

    Raises:
        ConfigError: a rule is of a kind that streams cannot have, or selects messages.
    """

    def __init__(self, rules: Sequence[Rule], *, to_cfs: bool) -> None:
        for rule in rules:
            _check(rule)
        self._rules = {
            place: rule
            for place, rule in enumerate(rules)
            if rule.enabled and rule.scope.to_cfs in {None, to_cfs}
        }
        self.struck = [0] * len(rules)
        self._free: dict[int, int] = {}
        self._last = 0

    def leave(self, now: int, size: int) -> int:
        """Return when bytes that came at ``now`` may leave, ns; never before earlier bytes.

        Args:
            now: ns since the start of the relay.
            size: number of bytes.
        """
        at = max(now, self._last)
        for place, rule in self._rules.items():
            if not rule.schedule.active(now):
                continue
            before = at
            kind = rule.kind.name
            if kind == "delay":
                at = max(at, now + int(rule.values["time"]))
            elif kind == "silence":
                at = max(at, self._stalled_until(rule, now))
            else:
                begin = max(now, self._free.get(place, 0))
                self._free[place] = begin + round(8 * size * SECOND / float(rule.values["rate"]))
                at = max(at, self._free[place])
            self.struck[place] += at > before
        self._last = at
        return at

    @staticmethod
    def _stalled_until(rule: Rule, now: int) -> int:
        """Return the end of the stall at ``now``, else ``now``; stalls begin with the rule's time."""
        since = now - rule.schedule.from_ns
        if rule.schedule.period_ns:
            since %= rule.schedule.period_ns
        return max(now, now - since + int(rule.values["time"]))


def _check(rule: Rule) -> None:
    """Refuse a rule that a stream cannot have.

    Raises:
        ConfigError: it is such a rule.
    """
    kinds = ", ".join(STREAM_KINDS)
    if rule.kind.name not in STREAM_KINDS:
        raise ConfigError(
            f"--fault {rule}: a TCP stream cannot have this fault: its bytes arrive all, once and in order, "
            f"or it ends; there are {kinds} and --cut"
        )
    if RuleScope(to_cfs=rule.scope.to_cfs) != rule.scope:
        raise ConfigError(f"--fault {rule}: a TCP stream is relayed as bytes; only to= can choose")
    if rule.schedule.every or rule.schedule.probability < 1:
        raise ConfigError(f"--fault {rule}: a TCP stream has no datagrams to choose; use from= and until=")
