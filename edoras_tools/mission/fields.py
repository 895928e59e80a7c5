"""Typed access to one node's parameters: returns a value of the right kind, or None and reports a mistake."""

from __future__ import annotations

import ipaddress
import math
from typing import TYPE_CHECKING

import msgspec

from edoras_tools.mission.report import Mistakes, printable
from edoras_tools.mission.scalars import read_scalar
from edoras_tools.mission.tree import ScalarNode
from edoras_tools.words import did_you_mean, either

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.mission.parameters import NodeParameters


def suggestion(word: str, choices: Iterable[str]) -> str:
    """Return ``did you mean ...? `` with the nearest choice, or an empty text."""
    near = did_you_mean(word, choices, 1)
    return f"{near} " if near else ""


class Fields(msgspec.Struct, frozen=True):
    """The parameters of one node and the report of its file."""

    node: NodeParameters
    report: Mistakes

    def mistake(self, name: str, text: str) -> None:
        """Report a mistake at the line of the parameter, or of the nearest group around it."""
        self.report.mistake(self.node.line_of(name), name, text)

    def warn(self, name: str, text: str) -> None:
        """Report a warning at the line of the parameter."""
        self.report.warn(self.node.line_of(name), name, text)

    def has(self, name: str) -> bool:
        """Return whether the file has the parameter, valid or not."""
        return name in self.node.values or name in self.node.groups

    def text(self, name: str, allowed: str) -> str | None:
        """Return a string. The bridges throw for any other type."""
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        if isinstance(scalar.value, str):
            return scalar.value
        self.mistake(
            name, f'{scalar.described}; a string is needed: write "{printable(scalar.text)}" in quotes'
        )
        return None

    def integer(
        self, name: str, lowest: int = -(2**63), highest: int = 2**63 - 1, allowed: str = ""
    ) -> int | None:
        """Return an integer within limits. The bridges throw for a string, a float or a boolean."""
        allowed = allowed or f"an integer from {lowest} to {highest} is needed"
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        value = scalar.value
        if isinstance(value, bool) or not isinstance(value, int):
            unquoted = read_scalar(scalar.text.strip())
            if isinstance(value, str) and isinstance(unquoted, int) and not isinstance(unquoted, bool):
                allowed = f"write {printable(scalar.text.strip())} without quotes"
            self.mistake(name, f"{scalar.described}; {allowed}")
            return None
        if not lowest <= value <= highest:
            self.mistake(name, f"{printable(scalar.text)} is out of range; {allowed}")
            return None
        return value

    def flag(self, name: str) -> bool | None:
        """Return a boolean; None if it is absent or wrong."""
        allowed = "true or false is needed"
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        if isinstance(scalar.value, bool):
            return scalar.value
        self.mistake(name, f"{scalar.described}; {allowed}")
        return None

    def rate(self, name: str) -> float | None:
        """Return a rate in Hz, an integer or a float above 0; None if it is absent or wrong."""
        if not self.has(name):
            return None
        allowed = "a rate in messages a second is needed, as 30 or 0.5"
        scalar = self._scalar(name, allowed)
        if scalar is None:
            return None
        value = scalar.value
        if isinstance(value, bool | str) or not 0 < value < math.inf:
            self.mistake(name, f"{scalar.described}; {allowed}")
            return None
        return float(value)

    def word(self, name: str, choices: Sequence[str]) -> str | None:
        """Return one of the given words; None if it is absent or wrong."""
        if not self.has(name):
            return None
        allowed = f"{either(choices)} is needed"
        text = self.text(name, allowed)
        if text is None or text in choices:
            return text
        self.mistake(name, f'"{printable(text)}" is not known; {suggestion(text, choices)}{allowed}')
        return None

    def count(self, name: str, highest: int) -> int | None:
        """Return an integer from 1 to ``highest``; None if it is absent or wrong."""
        return self.integer(name, 1, highest) if self.has(name) else None

    def address(self, name: str) -> str | None:
        """Return a dotted IPv4 address. The bridges pass it to ``inet_addr``, which resolves no names."""
        text = self.text(name, allowed="an IPv4 address is needed, as 127.0.0.1")
        if text is None:
            return None
        try:
            return str(ipaddress.IPv4Address(text))
        except ValueError:
            reason = "is not an IPv4 address; the bridges resolve no host names: write it as 127.0.0.1"
            self.mistake(name, f'"{printable(text)}" {reason}')
            return None

    def msg_ids(self, name: str) -> tuple[int, ...]:
        """Return a list of MsgIds; empty if it is absent or wrong."""
        allowed = "a list of MsgIds from 0x1 to 0x1FFF is needed, as [0x18C8, 0x8C2]"
        value = self.node.values.get(name)
        if isinstance(value, tuple) and all(
            type(item.value) is int and 0 < item.value <= 0x1FFF for item in value
        ):
            return tuple(int(item.value) for item in value)
        if self.has(name):
            self.mistake(name, allowed)
        return ()

    def keys(self, name: str) -> list[ScalarNode]:
        """Return a list of strings, each with its line; empty if it is absent or wrong."""
        allowed = "a list of keys is needed, as ['cmd_twist']"
        value = self.node.values.get(name)
        if isinstance(value, ScalarNode):
            self.mistake(name, f"{value.described}; {allowed}")
        elif value is None:
            self._absent(name, allowed)
        elif not value:
            self.warn(name, "an empty list, which ROS 2 refuses; [''] is an empty list to a bridge")
        elif not isinstance(value[0].value, str):
            self.mistake(name, f"{value[0].described}; {allowed}")
        else:
            return list(value)
        return []

    def _scalar(self, name: str, allowed: str) -> ScalarNode | None:
        value = self.node.values.get(name)
        if isinstance(value, ScalarNode):
            return value
        if value is None:
            self._absent(name, allowed)
        else:
            self.mistake(name, f"a list; {allowed}")
        return None

    def _absent(self, name: str, allowed: str) -> None:
        """Report a parameter without a value, unless the reader of the file has reported it."""
        if name in self.node.groups:
            self.mistake(name, f"a mapping; {allowed}")
        elif name not in self.node.values:
            self.mistake(name, f"missing; {allowed}")
