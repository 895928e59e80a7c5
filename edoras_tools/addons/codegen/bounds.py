"""Maximum lengths of sequences and strings: without a heap, each takes the space of its longest value."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.ros.types.schema import STRINGS, Definition, MessageField, Shape, full_name

if TYPE_CHECKING:
    from collections.abc import Iterable


STRINGS_DEFAULT: Final = 64
SEQUENCES_DEFAULT: Final = 32
_LARGEST_BOUND: Final = 1 << 24
"""Largest bound of one field."""
_RULE: Final = re.compile(r"(?P<type>[\w/]+)\.(?P<field>\w+)(?P<each>\[\])?=(?P<most>\w+)", re.ASCII)


class BoundRule(msgspec.Struct, frozen=True):
    """A bound on one field from the command line.

    Attributes:
        text: text as given.
        type: full name of the message type that has the field.
        field: name of the field.
        each: whether the bound is for the strings of a sequence or array, not for their number.
        most: maximum number of elements, characters (UTF-8 bytes) or UTF-16 units.
    """

    text: str
    type: str
    field: str
    each: bool
    most: int

    @classmethod
    def read(cls, text: str) -> BoundRule:
        """Read ``TYPE.FIELD=MOST``, or ``TYPE.FIELD[]=MOST`` for the strings of a sequence.

        Raises:
            ConfigError: the text is not such a rule.
        """
        match = _RULE.fullmatch(text.replace(" ", ""))
        most = _whole(match["most"]) if match else 0
        if match is None or not 1 <= most <= _LARGEST_BOUND:
            raise ConfigError(
                f"--bound: {text!r} is not TYPE.FIELD=MOST with MOST from 1 to {_LARGEST_BOUND}; "
                "write sensor_msgs/msg/JointState.name=16, or .name[]=20 for the strings in it"
            )
        return cls(text, full_name(match["type"]), match["field"], match["each"] is not None, most)


class Bounds(msgspec.Struct, frozen=True):
    """The bound of every field.

    Attributes:
        strings: maximum characters of a string without a bound in its definition or a rule.
        sequences: maximum elements of a sequence without a bound in its definition or a rule.
        rules: rules, which precede both; they may lower a definition's own bound, not raise it.
    """

    strings: int = STRINGS_DEFAULT
    sequences: int = SEQUENCES_DEFAULT
    rules: tuple[BoundRule, ...] = ()

    def elements(self, owner: str, item: MessageField) -> int:
        """Return the elements of an array, or the maximum of a sequence; 0 for a single value."""
        if item.shape is not Shape.SEQUENCE:
            return item.size
        return self._rule(owner, item.name, each=False) or item.size or self.sequences

    def characters(self, owner: str, item: MessageField) -> int:
        """Return the maximum characters of a string, or of each one in an array or sequence; else 0."""
        if item.type not in STRINGS:
            return 0
        each = item.shape is not Shape.SCALAR
        return self._rule(owner, item.name, each=each) or item.string_bound or self.strings

    def _rule(self, owner: str, field: str, *, each: bool) -> int:
        """Return the bound that the last rule on a field gives; 0 if there is none."""
        key = owner, field, each
        return next((rule.most for rule in self.rules[::-1] if (rule.type, rule.field, rule.each) == key), 0)

    def check(self, definitions: Iterable[Definition]) -> None:
        """Check that every rule names an existing field, and may bound it.

        Raises:
            ConfigError: some rules do not, one line each.
        """
        fields = {(item.name, each.name): each for item in definitions for each in item.fields}
        types = {owner for owner, _ in fields}
        mistakes = [
            f"--bound: {rule.text}: {why}"
            for rule in self.rules
            if (why := _refusal(rule, fields.get((rule.type, rule.field)), type_known=rule.type in types))
        ]
        if mistakes:
            raise ConfigError(*mistakes)


def _refusal(rule: BoundRule, item: MessageField | None, *, type_known: bool) -> str:
    """Return the reason why a rule cannot be applied; empty if it can."""
    if item is None:
        return (
            f"{rule.type} has no field {rule.field}" if type_known else f"{rule.type} is in none of the types"
        )
    is_text, is_many = item.type in STRINGS, item.shape is not Shape.SCALAR
    if rule.each and not (is_text and is_many):
        return f"{item.type_text} holds no strings; write {rule.type}.{rule.field}={rule.most}"
    if not rule.each and item.shape is Shape.ARRAY:
        return f"{item.type_text} always holds {item.size} elements"
    if not rule.each and not is_many and not is_text:
        return f"{item.type_text} takes no bound"
    own = item.string_bound if rule.each or not is_many else item.size
    return f"its definition says at most {own}" if own and rule.most > own else ""


def _whole(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        return 0
