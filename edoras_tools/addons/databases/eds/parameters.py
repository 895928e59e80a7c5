"""Design parameters: ``${PACKAGE/NAME}`` in an attribute, and arithmetic as cFE's sheets use it.

An expression has numbers (decimal, or hexadecimal behind ``0x``), ``+ - * / ^`` and parentheses. A text that
is no expression keeps its value. Values, lengths and depth are limited: a few parameters that contain each
other many times cannot produce a text that fills the memory.
"""

from __future__ import annotations

import re
from contextlib import suppress
from math import inf
from operator import add, mul, sub
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.databases.documents import SheetError

if TYPE_CHECKING:
    from collections.abc import Mapping

_REFERENCE: Final = re.compile(r"\$\{([^{}]*)\}")
_TOKEN: Final = re.compile(r"0[xX][0-9a-fA-F]+|\d+\.?\d*(?:[eE][-+]?\d+)?|\S", re.ASCII)
_LONGEST: Final = 1000
_DEEPEST: Final = 32
_HIGHEST: Final = 1 << 64
_BINDINGS: Final = {"+": 1, "-": 1, "*": 2, "/": 2, "^": 4}
_NEGATION: Final = 3
"""How tightly operators bind; a sign in front of a number less than a power."""
Number = int | float


class Parameters:
    """The design parameters of some sheets.

    Args:
        defines: text of each parameter, by package and name as in ``CFE_MISSION/SPACECRAFT_ID``.
    """

    def __init__(self, defines: Mapping[str, str]) -> None:
        self._defines = defines
        self._values: dict[str, str] = {}
        self._open: list[str] = []

    def text(self, raw: str, package: str) -> str:
        """Return an attribute with its parameters replaced by their values.

        Args:
            package: package of the attribute, and of parameters without a package.

        Raises:
            SheetError: a parameter is in none of the sheets, or contains itself; or the text is too long.
        """
        text = _REFERENCE.sub(lambda match: self._value(match[1].strip(), package), raw)
        if len(text) > _LONGEST:
            raise SheetError(f"{raw[:40]!r} stands for more than {_LONGEST} characters")
        return text

    def number(self, raw: str, package: str) -> Number:
        """Return the value of an expression.

        Raises:
            SheetError: see ``text``; or the text is no expression, or out of range.
        """
        return _Expression(self.text(raw, package)).value()

    def integer(self, raw: str, package: str) -> int:
        """Return the value of an integer expression.

        Raises:
            SheetError: see ``number``; or the value is no integer.
        """
        value = self.number(raw, package)
        if value != int(value):
            raise SheetError(f"{raw!r} is {value}, no integer")
        return int(value)

    def _value(self, name: str, package: str) -> str:
        key = name if "/" in name else f"{package}/{name}"
        if key in self._values:
            return self._values[key]
        if key not in self._defines:
            raise SheetError(f"parameter {key} is in none of these files")
        if key in self._open or len(self._open) > _DEEPEST:
            raise SheetError(f"parameter {key} contains itself")
        self._open.append(key)
        try:
            text = self.text(self._defines[key], key.rpartition("/")[0])
        finally:
            self._open.pop()
        with suppress(SheetError):  # a text, such as the name of a type
            text = str(_Expression(text).value())
        self._values[key] = text
        return text


class _Expression:
    """Evaluator of arithmetic, from left to right with one token of look-ahead."""

    def __init__(self, text: str) -> None:
        self._text = text
        self._tokens = _TOKEN.findall(text)[::-1]

    def value(self) -> Number:
        value = self._operators(0, 1)
        if self._tokens:
            raise self._error(" is no number")
        return value

    def _operators(self, least: int, depth: int) -> Number:
        """Return the value of an operand, and of the operators behind it that bind more than ``least``."""
        if depth > _DEEPEST:
            raise self._error(" is nested too deeply")
        first = self._tokens.pop() if self._tokens else ""
        if first == "-":
            value = -self._operators(_NEGATION, depth + 1)
        elif first == "(":
            value = self._operators(0, depth + 1)
            if not self._tokens or self._tokens.pop() != ")":
                raise self._error(": a parenthesis is not closed")
        elif first[:2] in {"0x", "0X"}:
            value = self._checked(int(first, 16))
        elif first.isascii() and first[:1].isdigit():
            value = self._checked(int(first) if first.isdigit() else float(first))
        else:
            raise self._error(" is no number")
        while self._tokens and (binding := _BINDINGS.get(self._tokens[-1], 0)) > least:
            sign = self._tokens.pop()
            power = sign == "^"  # from right to left
            other = self._operators(binding - power, depth + power)
            value = self._checked(self._calculated(value, sign, other))
        return value

    def _calculated(self, value: Number, sign: str, other: Number) -> Number:
        if sign == "^":
            if abs(other) > 64 or (value < 0 and other != int(other)) or (not value and other < 0):
                raise self._error(" has no value here")
            with suppress(OverflowError):
                return value**other
            return inf
        if sign == "/" and not other:
            raise self._error(" divides by 0")
        if sign == "/":
            exact = isinstance(value, int) and isinstance(other, int) and not value % other
            return value // other if exact else value / other
        return {"+": add, "-": sub, "*": mul}[sign](value, other)

    def _checked(self, value: Number) -> Number:
        if not -_HIGHEST <= value <= _HIGHEST:
            raise self._error(" is over 2^64")
        return value

    def _error(self, why: str) -> SheetError:
        return SheetError(f"{self._text[:80]!r}{why}")
