"""Design parameters: ``${PACKAGE/NAME}`` in an attribute, and arithmetic as cFE's sheets use it.

An expression has numbers (decimal, or hexadecimal behind ``0x``), ``+ - * / ^`` and parentheses. A text that
is no expression keeps its value. Values, lengths and depth are limited: a few parameters that contain each
other many times cannot produce a text that fills the memory.
"""

from __future__ import annotations

import re
from contextlib import suppress
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.databases.documents import SheetError

if TYPE_CHECKING:
    from collections.abc import Mapping

_REFERENCE: Final = re.compile(r"\$\{([^{}]*)\}")
_TOKEN: Final = re.compile(r"\s*(0[xX][0-9a-fA-F]+|\d+\.?\d*(?:[eE][-+]?\d+)?|[-+*/^()])\s*", re.ASCII)
_LONGEST: Final = 1000
_DEEPEST: Final = 32
_HIGHEST: Final = 1 << 64
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
        self._tokens: list[str] = []
        at = 0
        while at < len(text) and (match := _TOKEN.match(text, at)):
            self._tokens.append(match[1])
            at = match.end()
        if at < len(text) or not self._tokens:
            raise SheetError(f"{text[:80]!r} is no number")
        self._tokens.reverse()
        self._depth = 0

    def value(self) -> Number:
        value = self._sum()
        if self._tokens:
            raise SheetError(f"{self._text[:80]!r} is no number")
        return value

    def _next(self, among: str) -> str:
        """Return the next token and advance if it is one of these; else return an empty text."""
        return self._tokens.pop() if self._tokens and self._tokens[-1] in among.split() else ""

    def _sum(self) -> Number:
        value = self._product()
        while sign := self._next("+ -"):
            other = self._product()
            value = self._checked(value + other if sign == "+" else value - other)
        return value

    def _product(self) -> Number:
        value = self._signed()
        while sign := self._next("* /"):
            other = self._signed()
            if sign == "/" and not other:
                raise SheetError(f"{self._text[:80]!r} divides by 0")
            exact = sign == "/" and isinstance(value, int) and isinstance(other, int) and not value % other
            value = self._checked(
                value * other if sign == "*" else value // other if exact else value / other
            )
        return value

    def _signed(self) -> Number:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise SheetError(f"{self._text[:80]!r} is nested too deeply")
        value = -self._signed() if self._next("-") else self._power()
        self._depth -= 1
        return value

    def _power(self) -> Number:
        base = self._atom()
        if not self._next("^"):
            return base
        exponent = self._signed()
        if abs(exponent) > 64 or (base < 0 and exponent != int(exponent)) or (not base and exponent < 0):
            raise SheetError(f"{self._text[:80]!r} has no value here")
        return self._checked(base**exponent)

    def _atom(self) -> Number:
        if self._next("("):
            value = self._sum()
            if not self._next(")"):
                raise SheetError(f"{self._text[:80]!r}: a parenthesis is not closed")
            return value
        token = self._tokens.pop() if self._tokens else ""
        if not token[:1].isdigit():
            raise SheetError(f"{self._text[:80]!r} is no number")
        if token[:2] in {"0x", "0X"}:
            return self._checked(int(token, 16))
        return self._checked(int(token) if token.isdigit() else float(token))

    def _checked(self, value: Number) -> Number:
        if not -_HIGHEST <= value <= _HIGHEST:
            raise SheetError(f"{self._text[:80]!r} is over 2^64")
        return value
