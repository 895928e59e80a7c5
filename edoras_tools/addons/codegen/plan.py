"""Message types for C: their names, in the order that C requires, each with the maximum size of its fields.

The size of the longest message includes padding. Padding depends on the position of a value, and that on the
lengths of the strings before it. Only the position modulo 8 matters. So a value is an 8 by 8 matrix: from a
start at position ``r`` to an end at position ``s``, the maximum size, or ``_NEVER``. Two values in sequence
are the product of their matrices, in the algebra where plus is maximum and times is plus; a repeated value is
a power, computed by repeated squaring.

Maximum lengths of sequences and strings: without a heap, each takes the space of its longest value.
"""

from __future__ import annotations

import hashlib
import math
import re
import struct
from collections.abc import Collection, Iterable
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.errors import ConfigError
from edoras_tools.ros import TypeStore, library
from edoras_tools.ros.cdr.plan import WIDE_UNIT
from edoras_tools.ros.cdr.values import ENCAPSULATION_BYTES

if TYPE_CHECKING:
    from edoras_tools.wire.arrays import Integers

_KEYWORDS: Final = frozenset(
    """
    auto break case char const continue default do double else enum extern float for goto if inline int
    long register restrict return short signed sizeof static struct switch typedef union unsigned void
    volatile while bool true false asm and bitand bitor catch class compl const_cast constexpr decltype
    delete dynamic_cast explicit export friend mutable namespace new noexcept not nullptr operator or
    private protected public reinterpret_cast static_assert static_cast template this thread_local throw
    try typeid typename using virtual wchar_t xor linux unix
    """.split()  # noqa: SIM905  read as a text
)
"""Keywords of C and C++, and macros that compilers define."""
_TAKEN: Final = frozenset({"init", "read", "write", "encode", "decode", "MAX_CDR"})
"""Suffixes of names in C that are functions or constants of a type."""


def c_type_name(ros: str) -> str:
    """Return a message type's C name, as rosidl makes it: ``geometry_msgs__msg__Twist``."""
    return ros.replace("/", "__")


def member_name(ros: str, others: Collection[str] = ()) -> str:
    """Return a field's C name: its own; a keyword gets as many ``_`` behind it as needed.

    Args:
        ros: name in ROS.
        others: names of the other fields of the message.
    """
    name = ros
    while name in _KEYWORDS or (name != ros and name in others):
        name += "_"
    return name


def constant_name(owner: str, ros: str) -> str:
    """Return a constant's C name, as rosidl makes it."""
    return f"{c_type_name(owner)}__{ros}{'_' if ros in _TAKEN else ''}"


def literal(ros_type: str, value: Any) -> str:
    """Return a primitive or a string as a C constant of exactly its type."""
    if ros_type == "string":
        return string_literal(value)
    if ros_type == "bool":
        return "true" if value else "false"
    if ros_type.startswith("float"):
        return _floating(value, "F" if ros_type == "float32" else "")
    return _integer(ros_type, value)


def string_literal(value: str) -> str:
    """Return a string literal; characters other than printable ASCII are octal escapes of three digits."""
    return (
        '"'
        + "".join(
            chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
            for byte in value.encode("utf-8", "surrogatepass")
        )
        + '"'
    )


def comment(value: str) -> str:
    """Return a text that is safe inside a comment."""
    return value.replace("*/", "* /").replace("/*", "/ *")


def _integer(ros_type: str, value: int) -> str:
    suffix = "" if ros_type.startswith("int") else "U"
    digits = f"{abs(value)}{suffix}"
    if ros_type.endswith("64"):
        digits = f"{'U' * bool(suffix)}INT64_C({abs(value)})"
    if ros_type in {"int32", "int64"} and value == -(1 << (int(ros_type[3:]) - 1)):
        return f"(-{digits.replace(str(abs(value)), str(abs(value) - 1))} - 1)"
    return f"(-{digits})" if value < 0 else digits


def _floating(value: float, suffix: str) -> str:
    if math.isnan(value):
        return f"(0.0{suffix} / 0.0{suffix})"
    if math.isinf(value):
        return f"({'-' * (value < 0)}1.0{suffix} / 0.0{suffix})"
    digits = str(np.float32(value)) if suffix else repr(float(value))
    digits += suffix
    return f"({digits})" if value < 0 or digits.startswith("-") else digits


_PLACES: Final = 8
_NEVER: Final = -(1 << 60)
_MOST: Final = 1 << 50
"""Larger sizes are cut to this, so that sums do not overflow 64 bits."""


def nothing() -> Integers:
    """Return the matrix of an empty value."""
    return np.where(np.eye(_PLACES, dtype=bool), 0, _NEVER)


def aligned(size: int) -> Integers:
    """Return the matrix of a primitive, aligned to its size."""
    matrix = np.full((_PLACES, _PLACES), _NEVER)
    for start in range(_PLACES):
        step = -start % size + size
        matrix[start, (start + step) % _PLACES] = step
    return matrix


def then(first: Integers, second: Integers) -> Integers:
    """Return the matrix of two values in sequence."""
    total: Integers = (first[:, :, None] + second[None, :, :]).max(axis=1)
    return np.where(total < 0, _NEVER, np.minimum(total, _MOST))


def times(matrix: Integers, count: int) -> Integers:
    """Return the matrix of a value repeated ``count`` times."""
    result = nothing()
    while count:
        if count & 1:
            result = then(result, matrix)
        matrix = then(matrix, matrix)
        count >>= 1
    return result


def up_to(matrix: Integers, most: int) -> Integers:
    """Return the matrix of a value repeated 0 to ``most`` times."""
    return times(np.maximum(matrix, nothing()), most)


_LARGEST_MESSAGE: Final = 1 << 26
"""Maximum size of one message, bytes; a larger static array is a mistake."""


class CMember(msgspec.Struct, frozen=True):
    """One field of a message.

    Attributes:
        ros: field of the definition.
        name: name in C.
        elements: number of elements of an array, or maximum of a sequence; 0 for a single value.
        characters: maximum length of a string, without its end; 0 for other types.
        message: type of a nested message.
    """

    ros: library.MessageField
    name: str
    elements: int
    characters: int
    message: Message | None

    @property
    def is_sequence(self) -> bool:
        """Whether a count comes first."""
        return self.ros.shape is library.Shape.SEQUENCE

    @property
    def kind(self) -> str:
        """Kind of its element or elements, as in the names of the runtime's functions."""
        if self.message:
            return "message"
        return "uint8" if self.ros.type in {"byte", "char"} else self.ros.type


class Message(msgspec.Struct, frozen=True, dict=True):
    """One message type.

    Attributes:
        definition: definition that it was made from.
        members: members in wire order; an empty message has the placeholder that ROS 2 sends.
        most_trailing: maximum number of bytes that writers of ROS 2 may leave behind the last field.
    """

    definition: library.Definition
    members: tuple[CMember, ...]
    most_trailing: int

    @property
    def ros_name(self) -> str:
        """Name as ``geometry_msgs/msg/Twist``."""
        return self.definition.name

    @property
    def name(self) -> str:
        """Name of the C type, and prefix of its functions."""
        return c_type_name(self.ros_name)

    @property
    def package(self) -> str:
        """Package as ``geometry_msgs``."""
        return self.ros_name.partition("/")[0]

    @property
    def short_name(self) -> str:
        """Name as ``Twist``."""
        return self.ros_name.rpartition("/")[2]

    @property
    def fingerprint(self) -> str:
        """Start of the SHA-256 of its definition, hex."""
        return hashlib.sha256(self.definition.text.encode()).hexdigest()[:16]

    @cached_property
    def matrix(self) -> Integers:
        """Matrix of its longest CDR, see the top of this file."""
        matrix = nothing()
        for member in self.members:
            matrix = then(matrix, _matrix(member))
        return matrix

    @cached_property
    def most_bytes(self) -> int:
        """Size of its longest CDR, including the encapsulation, bytes."""
        return ENCAPSULATION_BYTES + int(self.matrix[0].max())

    @cached_property
    def has_defaults(self) -> bool:
        """Whether a new message has values other than zeros."""
        return any(
            member.ros.default is not None or (member.message is not None and member.message.has_defaults)
            for member in self.members
        )


class CLibrary(msgspec.Struct, frozen=True):
    """All messages that are generated together.

    Attributes:
        messages: messages; each comes after those that it nests.
        requested: requested messages, sorted by type; the others are nested in them.
    """

    messages: tuple[Message, ...]
    requested: tuple[Message, ...]

    @property
    def packages(self) -> tuple[str, ...]:
        """Packages; each comes after those that it uses."""
        return tuple(dict.fromkeys(message.package for message in self.messages))

    def of(self, package: str) -> tuple[Message, ...]:
        """Return the messages of a package; each comes after those that it nests."""
        return tuple(message for message in self.messages if message.package == package)

    def uses(self, package: str) -> tuple[str, ...]:
        """Return the other packages whose messages a package nests, sorted."""
        used = {
            member.message.package for item in self.of(package) for member in item.members if member.message
        }
        return tuple(sorted(used - {package}))


def plan_messages(types: TypeStore, type_names: Iterable[str], bounds: Bounds) -> CLibrary:
    """Plan the messages for some types, and for all types nested in them.

    Raises:
        RouteError: a type is not known.
        ConfigError: a definition has mistakes, a bound does not fit it, or packages use each other.
    """
    names = sorted(set(type_names))
    definitions = {item.name: item for name in names for item in types.definitions(name)}
    bounds.check(definitions.values())
    messages: dict[str, Message] = {}
    for name in _ordered(definitions):
        members = _members(definitions[name], bounds, messages)
        message = messages[name] = Message(definitions[name], members, types.most_trailing(name))
        if message.most_bytes > _LARGEST_MESSAGE:
            raise ConfigError(
                f"{name}: {message.most_bytes:,} bytes at these bounds, {_LARGEST_MESSAGE:,} are the most; "
                "lower a --bound, as sequences=8"
            )
    return CLibrary(tuple(messages.values()), tuple(messages[name] for name in names))


def _ordered(definitions: dict[str, library.Definition]) -> list[str]:
    """Return the types, package by package, each after all types nested in it."""
    graph = {
        name: sorted({field.type for field in item.fields if "/" in field.type})
        for name, item in sorted(definitions.items())
    }
    packages = {name: name.partition("/")[0] for name in graph}
    uses: dict[str, set[str]] = {package: set() for package in sorted(packages.values())}
    for name, nested in graph.items():
        uses[packages[name]] |= {packages[item] for item in nested} - {packages[name]}
    try:
        order = list(TopologicalSorter({package: sorted(uses[package]) for package in uses}).static_order())
    except CycleError as error:
        raise ConfigError(
            f"packages use each other: {' > '.join(error.args[1])}; C wants one first"
        ) from error
    ranks = {package: rank for rank, package in enumerate(order)}
    return sorted(TopologicalSorter(graph).static_order(), key=lambda name: ranks[packages[name]])


def _members(
    definition: library.Definition, bounds: Bounds, messages: dict[str, Message]
) -> tuple[CMember, ...]:
    owner, names = definition.name, {item.name for item in definition.fields}
    members = tuple(
        CMember(
            item,
            member_name(item.name, names),
            bounds.elements(owner, item),
            bounds.characters(owner, item),
            messages.get(item.type),
        )
        for item in definition.fields
    )
    for member in members:
        _check_default(owner, member)
    placeholder = library.MessageField(library.PLACEHOLDER, "uint8")
    return members or (CMember(placeholder, library.PLACEHOLDER, 0, 0, None),)


def _check_default(owner: str, member: CMember) -> None:
    """Check that a default value fits the bounds."""
    default = member.ros.default
    if default is None:
        return
    values = default if isinstance(default, list) else [default]
    units = str.encode if member.ros.type == "string" else utf16
    longest = max((len(units(item)) for item in values), default=0) if member.characters else 0
    for unit, length, most in (
        ("elements", len(values), member.elements),
        ("characters", longest, member.characters),
    ):
        if most and length > most:
            raise ConfigError(
                f"{owner}.{member.ros.name}: its default has {length} {unit}, its bound is {most}"
            )


def utf16(value: str) -> tuple[int, ...]:
    """Return the UTF-16 units of a string."""
    data = value.encode("utf-16-le", "surrogatepass")
    return struct.unpack(f"<{len(data) // 2}H", data)


def _matrix(member: CMember) -> Integers:
    """Return the matrix of a field's longest CDR."""
    if member.message:
        one = member.message.matrix
    elif member.ros.type in library.STRINGS:
        narrow = member.ros.type == "string"
        unit = aligned(1 if narrow else WIDE_UNIT)
        most = member.characters + narrow
        one = then(aligned(4), up_to(unit, most))
    else:
        one = aligned(struct.calcsize("<" + library.PRIMITIVES[member.ros.type]))
    if member.is_sequence:
        return then(aligned(4), up_to(one, member.elements))
    return times(one, member.elements) if member.elements else one


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
        return cls(text, library.full_name(match["type"]), match["field"], match["each"] is not None, most)


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

    def elements(self, owner: str, item: library.MessageField) -> int:
        """Return the elements of an array, or the maximum of a sequence; 0 for a single value."""
        if item.shape is not library.Shape.SEQUENCE:
            return item.size
        return self._rule(owner, item.name, each=False) or item.size or self.sequences

    def characters(self, owner: str, item: library.MessageField) -> int:
        """Return the maximum characters of a string, or of each one in an array or sequence; else 0."""
        if item.type not in library.STRINGS:
            return 0
        each = item.shape is not library.Shape.SCALAR
        return self._rule(owner, item.name, each=each) or item.string_bound or self.strings

    def _rule(self, owner: str, field: str, *, each: bool) -> int:
        """Return the bound that the last rule on a field gives; 0 if there is none."""
        key = owner, field, each
        return next((rule.most for rule in self.rules[::-1] if (rule.type, rule.field, rule.each) == key), 0)

    def check(self, definitions: Iterable[library.Definition]) -> None:
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


def _refusal(rule: BoundRule, item: library.MessageField | None, *, type_known: bool) -> str:
    """Return the reason why a rule cannot be applied; empty if it can."""
    if item is None:
        return (
            f"{rule.type} has no field {rule.field}" if type_known else f"{rule.type} is in none of the types"
        )
    is_text, is_many = item.type in library.STRINGS, item.shape is not library.Shape.SCALAR
    if rule.each and not (is_text and is_many):
        return f"{item.type_text} holds no strings; write {rule.type}.{rule.field}={rule.most}"
    if not rule.each and item.shape is library.Shape.ARRAY:
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
