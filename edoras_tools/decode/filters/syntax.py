"""The filter language: parses text into a tree of nodes with their positions in the text.

::

    either      = both { ("or" | "||") both }
    both        = single { ("and" | "&&") single }
    single      = ("not" | "!") single | "(" either ")" | comparison
    comparison  = operand [ "==" value | "!=" value | "<" value | "<=" value | ">" value | ">=" value
                          | ["not"] "in" (range | "{" item { "," item } "}")
                          | "contains" value | "matches" value ]
    operand     = name | ("any" | "all" | "len") "(" name ")"
    name        = part { "." part }             part = identifier [ "[" integer "]" ]
    item        = value | range                 range = value ".." value
    value       = quoted text | bare word

The field that a value is compared with decides the meaning of the value: see ``compare``.
"""

from __future__ import annotations

import re
from typing import Final, Literal

import msgspec

from edoras_tools.errors import ConfigError

Operator = Literal["==", "!=", "<", "<=", ">", ">=", "in", "not in", "contains", "matches"]
Wrap = Literal["", "any", "all", "len"]

_MOST_DEPTH: Final = 64
_SHOWN: Final = 100
"""Characters of an expression that a message shows around its mistake."""
_SPACE: Final = re.compile(r"\s*")
_NAME: Final = re.compile(r"[A-Za-z_]\w*(?:\[-?\d{1,9}\])?(?:\.[A-Za-z_]\w*(?:\[-?\d{1,9}\])?)*", re.ASCII)
_IDENTIFIER: Final = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_SYMBOL: Final = re.compile(r"==|!=|<=|>=|<|>")
_BARE: Final = re.compile(r"""(?:(?!\.\.)[^\s"'(){}\[\],=<>!&|])+""")
_QUOTED: Final = re.compile(r""""((?:\\.|[^"\\])*)"|'((?:\\.|[^'\\])*)'""", re.DOTALL)
_ESCAPE: Final = re.compile(r"""\\([\\"'])""")


class WhereError(ConfigError):
    """A filter with a mistake; the message has the reason, then the expression with a mark under the place.

    Attributes:
        why: reason, one line.
        at: position of the first wrong character, from 0.
        end: position after the last wrong character.
    """

    def __init__(self, text: str, at: int, end: int, why: str, option: str = "--where") -> None:
        start = max(0, min(at - _SHOWN // 2, len(text) - _SHOWN))
        why, plain = (
            "".join(char if char.isprintable() else "." for char in words)
            for words in (why, text[start : start + _SHOWN])
        )
        mark = "^" * max(1, min(end, start + _SHOWN) - at)
        super().__init__(
            f"{option}, character {at + 1}: {why}", f"  {plain}", f"  {' ' * (at - start)}{mark}"
        )
        self.why = why
        self.at = at
        self.end = end


class Value(msgspec.Struct, frozen=True):
    """A constant as written: ``text`` without quotes, and its position."""

    text: str
    at: int
    end: int
    quoted: bool = False


class ValueRange(msgspec.Struct, frozen=True):
    """All values from ``low`` to ``high``, both included."""

    low: Value
    high: Value


class Operand(msgspec.Struct, frozen=True):
    """A field's name as written, and the function of its values: any, all or len."""

    name: str
    at: int
    end: int
    wrap: Wrap = ""


class Presence(msgspec.Struct, frozen=True):
    """Whether a packet has a field."""

    operand: Operand


class Comparison(msgspec.Struct, frozen=True):
    """A field compared with constants; ``at`` and ``end`` are the operator's position."""

    operand: Operand
    operator: Operator
    at: int
    end: int
    items: tuple[Value | ValueRange, ...]


class Negation(msgspec.Struct, frozen=True):
    """The opposite of a node."""

    of: Expression


class Junction(msgspec.Struct, frozen=True):
    """All or any of some nodes must hold."""

    of: tuple[Expression, ...]
    every: bool


Expression = Presence | Comparison | Negation | Junction


def parse_filter(text: str) -> Expression:
    """Read an expression.

    Raises:
        WhereError: it is not one; points at the character.
    """
    return _Parser(text).whole()


def parse_names(text: str, option: str) -> list[Operand]:
    """Read comma-separated names of fields, as ``--fields`` takes them; ``len(...)`` is allowed.

    Raises:
        WhereError: one of them is no name of a field.
    """
    return _Parser(text, option).names()


class _Parser:
    """Recursive descent over the characters: the kind of a token depends on its place."""

    def __init__(self, text: str, option: str = "--where") -> None:
        self._text = text
        self._option = option
        self._at = 0
        self._depth = 0

    def whole(self) -> Expression:
        self._space()
        if self._at == len(self._text):
            raise self._wrong("the filter is empty; write one as: msg_id == 0x827 and pose.position.x > 1")
        node = self._either()
        if self._at < len(self._text):
            raise self._wrong("expected and, or, or the end")
        return node

    def names(self) -> list[Operand]:
        self._space()
        operands = [self._operand()]
        while self._take(","):
            operands.append(self._operand())
        wrong = next((item for item in operands if item.wrap in {"any", "all"}), None)
        if wrong is not None:
            raise self._wrong(f"{wrong.wrap}(...) is for comparisons", wrong.at, wrong.end)
        if self._at < len(self._text):
            raise self._wrong("expected a comma or the end")
        return operands

    def _wrong(self, why: str, at: int | None = None, end: int | None = None) -> WhereError:
        at = self._at if at is None else at
        return WhereError(self._text, at, at + 1 if end is None else end, why, self._option)

    def _space(self) -> None:
        match = _SPACE.match(self._text, self._at)
        self._at = match.end() if match else self._at

    def _take(self, *symbols: str) -> str:
        """Move past one of some symbols, if it is next."""
        symbol = next((item for item in symbols if self._text.startswith(item, self._at)), "")
        self._at += len(symbol)
        self._space()
        return symbol

    def _word(self, *words: str) -> str:
        """Move past one of some words, if it is next."""
        match = _IDENTIFIER.match(self._text, self._at)
        if match is None or match[0].lower() not in words:
            return ""
        self._at = match.end()
        self._space()
        return match[0].lower()

    def _either(self) -> Expression:
        nodes = [self._both()]
        while self._word("or") or self._take("||"):
            nodes.append(self._both())
        return Junction(tuple(nodes), every=False) if len(nodes) > 1 else nodes[0]

    def _both(self) -> Expression:
        nodes = [self._single()]
        while self._word("and") or self._take("&&"):
            nodes.append(self._single())
        return Junction(tuple(nodes), every=True) if len(nodes) > 1 else nodes[0]

    def _single(self) -> Expression:
        self._depth += 1
        if self._depth > _MOST_DEPTH:
            raise self._wrong(f"nested deeper than {_MOST_DEPTH}")
        try:
            if self._word("not") or (not self._text.startswith("!=", self._at) and self._take("!")):
                return Negation(self._single())
            opened = self._at
            if not self._take("("):
                return self._comparison()
            node = self._either()
            if not self._take(")"):
                missing = "expected and, or, or ) to close this"
                raise self._wrong(missing if self._at < len(self._text) else "this ( is not closed", opened)
            return node
        finally:
            self._depth -= 1

    def _comparison(self) -> Expression:
        operand = self._operand()
        at = self._at
        operator = self._operator()
        end = at + len(self._text[at : self._at].rstrip())
        if operator is None:
            if operand.wrap:
                raise self._wrong(f"{operand.wrap}(...) is to be compared, as {operand.wrap}(position) > 1")
            return Presence(operand)
        if operator not in {"in", "not in"}:
            return Comparison(operand, operator, at, end, (self._value(),))
        if not self._take("{"):
            item = self._item()
            if isinstance(item, Value):
                raise self._wrong("in wants a range or a set: 1..5, {1, 2, 5..9}", item.at, item.end)
            return Comparison(operand, operator, at, end, (item,))
        items = [self._item()]
        while self._take(","):
            items.append(self._item())
        if not self._take("}"):
            raise self._wrong("expected , or } in the set")
        return Comparison(operand, operator, at, end, tuple(items))

    def _operator(self) -> Operator | None:
        match = _SYMBOL.match(self._text, self._at)
        if match is not None:
            self._at = match.end()
            self._space()
            return match[0]  # type: ignore[return-value]  # the pattern holds the symbols of Operator
        if self._text.startswith("=", self._at):
            raise self._wrong("equality is written ==")
        word = self._word("in", "contains", "matches")
        if word:
            return word  # type: ignore[return-value]  # one of the three
        before = self._at
        if self._word("not"):
            if self._word("in"):
                return "not in"
            self._at = before
        return None

    def _operand(self) -> Operand:
        if self._at == len(self._text):
            raise self._wrong("a field's name belongs here, as msg_id")
        match = _NAME.match(self._text, self._at)
        if match is None:
            raise self._wrong("a field's name belongs here, as msg_id")
        wrap = match[0].lower()
        if wrap in {"any", "all", "len"} and self._text[match.end() :].lstrip().startswith("("):
            self._at = match.end()
            self._space()
            self._take("(")
            inner = self._operand()
            if inner.wrap or not self._take(")"):
                raise self._wrong(f"expected ) after the name in {wrap}(...)")
            return Operand(inner.name, inner.at, inner.end, wrap)  # type: ignore[arg-type]  # one of the three
        at, self._at = self._at, match.end()
        if self._text[self._at : self._at + 1] == "[":
            raise self._wrong("an index is a whole number, as poses[0] or poses[-1]")
        self._space()
        return Operand(match[0], at, match.end())

    def _item(self) -> Value | ValueRange:
        low = self._value()
        return ValueRange(low, self._value()) if self._take("..") else low

    def _value(self) -> Value:
        at = self._at
        if at == len(self._text):
            raise self._wrong("the filter ends where a value belongs")
        match = _QUOTED.match(self._text, at)
        quoted = match is not None
        if match is None:
            if self._text[at] in "\"'":
                raise self._wrong("this quote is not closed")
            match = _BARE.match(self._text, at)
        if match is None:
            raise self._wrong('a value belongs here: 42, 0x827, 1.5, 250ms, ci, "text"')
        self._at = match.end()
        self._space()
        if not quoted:
            return Value(match[0], at, match.end())
        inside = match[1] if match[1] is not None else match[2]
        return Value(_ESCAPE.sub(r"\1", inside), at, match.end(), quoted=True)
