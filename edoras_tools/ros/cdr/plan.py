"""A message type as a list of CDR steps, shared by every reader and writer of this package.

CDR aligns each primitive to its own size, counted from the byte after the encapsulation; nesting has no
effect (OMG CDR, formal/02-06-51, 15.3). So a type is a flat list of steps: a ``PrimitiveRun``, whose layout
is fixed once its start is aligned, a ``Text``, or a ``Repeat`` of another plan. A run ends before the first
primitive that is wider than its first one: only there can alignment depend on earlier values.

Bytes may follow the last field. Every receiver of ROS 2 ignores them, but too many of them mean another type.
The usual numbers:

1. Zero to ``ROUNDING``: a writer rounds the message up to 4 or 8 bytes.
2. ``rmw_serialize`` of Fast DDS and Zenoh returns the size that it estimated, not the size that it wrote. The
   estimate (rosidl_typesupport_fastrtps) aligns the elements of an empty sequence, counts one unit too many
   for a ``wstring``, and counts 16 bytes for each ``bool`` of a sequence in C++. ``CdrPlan.excess`` is the
   largest difference.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Final

import msgspec

from edoras_tools.errors import ConfigError
from edoras_tools.ros.library import PLACEHOLDER, PRIMITIVES, STRINGS, Definition, MessageField, Shape

MOST_STEPS: Final = 16_384
"""Most primitives and steps of one type; no sensible definition has more."""
_MOST_BYTES: Final = 1 << 24
"""Most bytes that the shortest message of a type may have."""
_MOST_DEPTH: Final = 64
ROUNDING: Final = 7
"""Most bytes that rounding adds after the last field."""
UNLIMITED: Final = 1 << 31
"""A number of bytes larger than any message."""
WIDE_UNIT: Final = 4
"""Bytes of one UTF-16 unit of a ``wstring``: all middleware of ROS 2 sends it as ``wchar_t``."""
_MANY_FIELDS: Final = 60
"""Number of fields above which ``dict(zip())`` builds a dict of flat values faster than a dict display."""
_CPP_BOOL: Final = 16
_MOST_COUNTED: Final = 256
"""Number of elements above which the excess of a sequence counts as unlimited."""


class Leaf(msgspec.Struct, frozen=True):
    """A primitive, or a fixed array of one, inside a run.

    Attributes:
        name: dotted path from the plan's root; empty for an element of a sequence of primitives.
        code: code of the type in ``struct``.
        size: bytes of one primitive.
        count: elements of a fixed array; None for a single value.
        offset: bytes from the start of the run.
    """

    name: str
    code: str
    size: int
    count: int | None
    offset: int

    @property
    def end(self) -> int:
        """One past the last byte, from the start of the run."""
        return self.offset + self.size * (1 if self.count is None else self.count)


class PrimitiveRun(msgspec.Struct, frozen=True):
    """Primitives at fixed offsets from a start aligned to ``alignment``.

    Attributes:
        alignment: size of the first primitive in bytes; no other one is wider.
        size: bytes from the start to the end of the last primitive.
        leaves: the primitives, in wire order.
        structs: structs that read all values, little-endian and big-endian.
    """

    alignment: int
    size: int
    leaves: tuple[Leaf, ...]
    structs: tuple[struct.Struct, struct.Struct]


class Text(msgspec.Struct, frozen=True):
    """A string: its length as u32, then the characters.

    Attributes:
        name: dotted path from the plan's root.
        bound: most characters that the type allows; 0 for no limit.
        width: 1 for UTF-8 with a NUL at the end, included in the length; ``WIDE_UNIT`` for UTF-16 without
            NUL.
    """

    name: str
    bound: int
    width: int


class Repeat(msgspec.Struct, frozen=True):
    """A repeated plan: an array of fixed length, or a sequence that starts with its count as u32.

    Attributes:
        name: dotted path from the plan's root.
        count: number of elements of an array; None for a sequence.
        bound: most elements of a sequence; 0 for no limit.
        plan: plan of one element.
    """

    name: str
    count: int | None
    bound: int
    plan: CdrPlan


PlanStep = PrimitiveRun | Text | Repeat


class CdrPlan(msgspec.Struct, frozen=True, dict=True):
    """The CDR layout of a type.

    Attributes:
        steps: in wire order.
        value: Python expression of the nested value, in which ``v`` is the list of flat values, in wire
            order.
    """

    steps: tuple[PlanStep, ...]
    value: str

    @cached_property
    def build(self) -> Callable[[Sequence[Any]], Any]:
        """Function from flat values to the nested value; one expression is three times as fast as calls."""
        return eval(f"lambda v: {self.value}")  # noqa: S307  names are quoted

    @cached_property
    def least(self) -> int:
        """Bytes of the shortest message of this type."""
        return sum(
            step.size if isinstance(step, PrimitiveRun) else 4 if isinstance(step, Text) else _least(step)
            for step in self.steps
        )

    @cached_property
    def uniform(self) -> PrimitiveRun | None:
        """The plan's only run, if its elements follow each other without gaps; else None."""
        step = self.steps[0]
        alone = len(self.steps) == 1 and isinstance(step, PrimitiveRun) and step.size % step.alignment == 0
        return step if alone and isinstance(step, PrimitiveRun) else None

    @cached_property
    def lists(self) -> bool:
        """Whether the type has arrays or sequences."""
        runs = [step for step in self.steps if isinstance(step, PrimitiveRun)]
        return any(isinstance(step, Repeat) for step in self.steps) or any(
            leaf.count is not None for run in runs for leaf in run.leaves
        )

    @cached_property
    def single(self) -> bool:
        """Whether the plan is one value, a primitive or a string, not a message."""
        step = self.steps[0]
        leaves = step.leaves if isinstance(step, PrimitiveRun) else ()
        return len(self.steps) == 1 and (
            not step.name if isinstance(step, Text) else [leaf.name for leaf in leaves] == [""]
        )

    @cached_property
    def element(self) -> Leaf | None:
        """The primitive, if this is the plan of an element of a sequence of primitives; else None."""
        run = self.uniform
        return run.leaves[0] if run and len(run.leaves) == 1 and not run.leaves[0].name else None

    @cached_property
    def excess(self) -> int:
        """Most bytes by which ``rmw_serialize`` overestimates a message; ``UNLIMITED`` if it has no limit."""
        return _excess(self, 0)

    @cached_property
    def most_trailing(self) -> int:
        """Most bytes that writers of ROS 2 leave after the last field."""
        return ROUNDING + self.excess

    @cached_property
    def fixed_size(self) -> int | None:
        """Bytes of the body if all messages have the same size; else None."""
        return _end(self, 0)


def _least(step: Repeat) -> int:
    return 4 if step.count is None else step.count * step.plan.least


def _end(plan: CdrPlan, position: int) -> int | None:
    """Return the end of a body of fixed size that starts at a position; None if its size varies."""
    for step in plan.steps:
        if isinstance(step, PrimitiveRun):
            position = _aligned(position, step.alignment) + step.size
        elif isinstance(step, Text) or step.count is None:
            return None
        else:
            for _ in range(step.count):
                end = _end(step.plan, position)
                if end is None:
                    return None
                position = end
    return position


def _excess(plan: CdrPlan, ahead: int) -> int:
    """Return the most bytes that the estimate is ahead after a plan, if it was ``ahead`` bytes before."""
    for step in plan.steps:
        if isinstance(step, PrimitiveRun):
            ahead = _aligned(ahead, step.alignment)
        elif isinstance(step, Text):
            ahead = _aligned(ahead, 4) + (step.width if step.width > 1 else 0)
        else:
            ahead = _excess_of_many(step, ahead)
    return min(ahead, UNLIMITED)


def _excess_of_many(step: Repeat, ahead: int) -> int:
    most = step.bound or UNLIMITED if step.count is None else step.count
    ahead = _aligned(ahead, 4) if step.count is None else ahead
    leaf = step.plan.element
    if leaf is not None and leaf.code == "?" and step.count is None:
        return _aligned(ahead, _CPP_BOOL) + (_CPP_BOOL - 1) * most + _CPP_BOOL
    if leaf is not None:
        if_empty = ahead + leaf.size - 4 if step.count is None and leaf.size > 4 else ahead
        return max(if_empty, _aligned(ahead, leaf.size))
    for _ in range(min(most, _MOST_COUNTED)):
        before, ahead = ahead, _excess(step.plan, ahead)
        if ahead == before:
            return ahead
    return ahead if most <= _MOST_COUNTED else UNLIMITED


def _aligned(position: int, alignment: int) -> int:
    return (position + alignment - 1) & -alignment


class Compiler:
    """Compiles definitions to plans and keeps the plans.

    Args:
        find: returns the definition of a type; raises if there is none.
    """

    def __init__(self, find: Callable[[str], Definition]) -> None:
        self._find = find
        self._plans: dict[str, CdrPlan] = {}
        self._open: list[str] = []

    def plan(self, name: str) -> CdrPlan:
        """Return the plan of a message type.

        Raises:
            ConfigError: the type contains itself, is too large, or has a field type that ROS 2 does not send.
        """
        if name not in self._plans:
            steps = _Steps(name)
            self._plans[name] = steps.finish(self._message(name, "", steps))
        return self._plans[name]

    def _message(self, name: str, prefix: str, steps: _Steps) -> str:
        """Append the steps of a message; return the expression of its dict."""
        if name in self._open or len(self._open) >= _MOST_DEPTH:
            raise ConfigError(f"{name}: the type contains itself: {' > '.join([*self._open[-4:], name])}")
        self._open.append(name)
        try:
            parts = {
                item.name: self._field(item, prefix + item.name, name, steps)
                for item in self._find(name).fields
            }
        finally:
            self._open.pop()
        if not parts:
            steps.primitive(prefix + PLACEHOLDER, "B", None)
        if len(parts) > _MANY_FIELDS and all(value.startswith("v[") for value in parts.values()):
            return f"dict(zip({tuple(parts)}, v[{steps.values - len(parts)}:{steps.values}]))"
        return f"{{{', '.join(f'{item!r}: {value}' for item, value in parts.items())}}}"

    def _field(self, field: MessageField, name: str, owner: str, steps: _Steps) -> str:
        code = PRIMITIVES.get(field.type)
        if field.shape is Shape.SCALAR:
            return self._one(field, name, owner, steps)
        if code and field.shape is Shape.ARRAY:
            return steps.primitive(name, code, field.size)
        element = _Steps(f"{owner}.{field.name}")
        value = self._one(field, "", owner, element)
        count, bound = (field.size, 0) if field.shape is Shape.ARRAY else (None, field.size)
        return steps.append(Repeat(name, count, bound, element.finish(value)))

    def _one(self, field: MessageField, name: str, owner: str, steps: _Steps) -> str:
        """Append one value of a field's type, without the field's shape; return its expression."""
        if code := PRIMITIVES.get(field.type):
            return steps.primitive(name, code, None)
        if field.type in STRINGS:
            return steps.append(Text(name, field.string_bound, 1 if field.type == "string" else WIDE_UNIT))
        if "/" not in field.type:
            raise ConfigError(f"{owner}.{field.name}: ROS 2 sends no {field.type}")
        return self._message(field.type, f"{name}." if name else "", steps)


class _Steps:
    """Collects steps, and joins primitives into runs; methods that add return the value's expression."""

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._steps: list[PlanStep] = []
        self._leaves: list[Leaf] = []
        self._total = 0
        self.values = 0

    def primitive(self, name: str, code: str, count: int | None) -> str:
        self._count()
        size = struct.calcsize("<" + code)
        if self._leaves and size > self._leaves[0].size:
            self._close_run()
        offset = (self._leaves[-1].end + size - 1) & -size if self._leaves else 0
        self._leaves.append(Leaf(name, code, size, count, offset))
        first = self.values
        self.values += 1 if count is None else count
        return f"v[{first}]" if count is None else f"[*v[{first}:{self.values}]]"

    def append(self, step: Text | Repeat) -> str:
        self._count()
        self._close_run()
        self._steps.append(step)
        self.values += 1
        return f"v[{self.values - 1}]"

    def finish(self, value: str) -> CdrPlan:
        self._close_run()
        plan = CdrPlan(tuple(self._steps), value)
        if plan.least > _MOST_BYTES:
            raise ConfigError(
                f"{self._owner}: its smallest message takes {plan.least} bytes; {_MOST_BYTES} is the most"
            )
        return plan

    def _count(self) -> None:
        self._total += 1
        if self._total > MOST_STEPS:
            raise ConfigError(f"{self._owner}: the type spells out more than {MOST_STEPS} values")

    def _close_run(self) -> None:
        if not self._leaves:
            return
        size = self._leaves[-1].end
        if size > _MOST_BYTES:
            raise ConfigError(
                f"{self._owner}: its smallest message takes {size} bytes; {_MOST_BYTES} is the most"
            )
        layout, position = "", 0
        for leaf in self._leaves:
            layout += f"{leaf.offset - position}x{'' if leaf.count is None else leaf.count}{leaf.code}"
            position = leaf.end
        structs = struct.Struct("<" + layout), struct.Struct(">" + layout)
        self._steps.append(PrimitiveRun(self._leaves[0].size, size, tuple(self._leaves), structs))
        self._leaves = []
