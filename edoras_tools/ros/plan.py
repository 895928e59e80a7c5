"""A message type as the few steps that its CDR takes, shared by every reader and writer of this package.

CDR aligns each primitive to its own size, counted from the byte after the encapsulation, and knows nothing of
nesting (OMG CDR, formal/02-06-51, 15.3). So a type is a flat list of steps: a ``Run`` of primitives whose
layout is fixed once its start is aligned, a ``Text``, or a ``Repeat`` of another plan. A run ends before the
first primitive that is wider than its first one: only there can alignment depend on what came before.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.errors import ConfigError
from edoras_tools.ros.schema import PLACEHOLDER, PRIMITIVES, STRINGS, Definition, Field, Shape

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

MOST_STEPS: Final = 16_384
"""Most primitives and steps of one type; a definition that spells out more is hostile."""
MOST_BYTES: Final = 1 << 24
"""Largest smallest message of a type."""
MOST_DEPTH: Final = 64


@dataclass(frozen=True, slots=True)
class Leaf:
    """A primitive, or a fixed array of one, inside a run.

    Attributes:
        name: dotted path from the plan's root; empty for the element of a sequence of primitives.
        code: ``struct`` code.
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


@dataclass(frozen=True, slots=True)
class Run:
    """Primitives at fixed offsets from a start aligned to ``alignment``.

    Attributes:
        alignment: size of the first primitive; none is wider.
        size: bytes from the start to the end of the last primitive.
        structs: reader and writer of all values, little-endian and big-endian.
    """

    alignment: int
    size: int
    leaves: tuple[Leaf, ...]
    structs: tuple[struct.Struct, struct.Struct]


@dataclass(frozen=True, slots=True)
class Text:
    """A string: its length as u32, then the characters.

    Attributes:
        name: dotted path from the plan's root.
        bound: most characters, as the type says; 0 for any.
        width: 1 for UTF-8 with a NUL at the end that the length counts; 2 or 4 bytes a UTF-16 unit, no NUL.
    """

    name: str
    bound: int
    width: int


@dataclass(frozen=True, slots=True)
class Repeat:
    """One plan several times: an array whose length is fixed, or a sequence that starts with a count as u32.

    Attributes:
        name: dotted path from the plan's root.
        count: elements of an array; None for a sequence.
        bound: most elements of a sequence; 0 for any.
    """

    name: str
    count: int | None
    bound: int
    plan: Plan


Step = Run | Text | Repeat


@dataclass(frozen=True)
class Plan:
    """How a type travels.

    Attributes:
        steps: in wire order.
        build: makes the nested value from the flat values of the steps, in wire order.
    """

    steps: tuple[Step, ...]
    build: Callable[[Iterator[Any]], Any]

    @cached_property
    def least(self) -> int:
        """Bytes that no message of this type is shorter than."""
        return sum(
            step.size if isinstance(step, Run) else 4 if isinstance(step, Text) else _least(step)
            for step in self.steps
        )

    @cached_property
    def uniform(self) -> Run | None:
        """The only run, where elements of this plan follow each other without gaps; else None."""
        step = self.steps[0]
        alone = len(self.steps) == 1 and isinstance(step, Run) and step.size % step.alignment == 0
        return step if alone and isinstance(step, Run) else None

    @cached_property
    def element(self) -> Leaf | None:
        """The only primitive of a sequence of primitives; else None."""
        run = self.uniform
        return run.leaves[0] if run and len(run.leaves) == 1 and not run.leaves[0].name else None

    @cached_property
    def fixed_size(self) -> int | None:
        """Bytes of the body where all messages have the same size; else None."""
        return _end(self, 0)


def _least(step: Repeat) -> int:
    return 4 if step.count is None else step.count * step.plan.least


def _end(plan: Plan, position: int) -> int | None:
    """Return where a body of fixed size that starts at a position ends."""
    for step in plan.steps:
        if isinstance(step, Run):
            position = (position + step.alignment - 1) & -step.alignment
            position += step.size
        elif isinstance(step, Text) or step.count is None:
            return None
        else:
            for _ in range(step.count):
                end = _end(step.plan, position)
                if end is None:
                    return None
                position = end
    return position


class Compiler:
    """Turns definitions into plans and remembers the plans.

    Args:
        find: returns the definition of a type; raises where there is none.
        wide: bytes of a ``wstring`` unit.
    """

    def __init__(self, find: Callable[[str], Definition], wide: int) -> None:
        self._find = find
        self._wide = wide
        self._plans: dict[str, Plan] = {}
        self._open: list[str] = []

    def plan(self, name: str) -> Plan:
        """Return the plan of a message type.

        Raises:
            ConfigError: the type contains itself, is absurdly large or uses what ROS 2 does not send.
        """
        if name not in self._plans:
            steps = _Steps(name)
            build = self._message(name, "", steps)
            self._plans[name] = steps.finish(build)
        return self._plans[name]

    def _message(self, name: str, prefix: str, steps: _Steps) -> Callable[[Iterator[Any]], Any]:
        """Append the steps of a message; return what builds its dict."""
        if name in self._open or len(self._open) >= MOST_DEPTH:
            raise ConfigError(f"{name}: the type contains itself: {' > '.join([*self._open[-4:], name])}")
        self._open.append(name)
        try:
            definition = self._find(name)
            parts = [
                (item.name, self._field(item, prefix + item.name, name, steps)) for item in definition.fields
            ]
        finally:
            self._open.pop()
        if not parts:
            steps.primitive(prefix + PLACEHOLDER, "B", None)
            return _empty
        names = tuple(item for item, _ in parts)
        if all(build is next for _, build in parts):
            return lambda values: dict(
                zip(names, values, strict=False)
            )  # takes from values only while names last
        return lambda values: {item: build(values) for item, build in parts}

    def _field(self, field: Field, name: str, owner: str, steps: _Steps) -> Callable[[Iterator[Any]], Any]:
        code = PRIMITIVES.get(field.type)
        if field.shape is Shape.SCALAR:
            return self._one(field, name, owner, steps)
        if code and field.shape is Shape.ARRAY:
            steps.primitive(name, code, field.size)
            return lambda values: list(islice(values, field.size))
        element = _Steps(f"{owner}.{field.name}")
        build = self._one(field, "", owner, element)
        count, bound = (field.size, 0) if field.shape is Shape.ARRAY else (None, field.size)
        steps.append(Repeat(name, count, bound, element.finish(build)))
        return next

    def _one(self, field: Field, name: str, owner: str, steps: _Steps) -> Callable[[Iterator[Any]], Any]:
        """Append one value of a field's type, whatever the field's shape."""
        if code := PRIMITIVES.get(field.type):
            steps.primitive(name, code, None)
            return next
        if field.type in STRINGS:
            steps.append(Text(name, field.string_bound, 1 if field.type == "string" else self._wide))
            return next
        if "/" not in field.type:
            raise ConfigError(f"{owner}.{field.name}: ROS 2 sends no {field.type}")
        return self._message(field.type, f"{name}." if name else "", steps)


class _Steps:
    """Collects steps, joining primitives to runs."""

    def __init__(self, owner: str) -> None:
        self._owner = owner
        self._steps: list[Step] = []
        self._leaves: list[Leaf] = []
        self._total = 0

    def primitive(self, name: str, code: str, count: int | None) -> None:
        self._count()
        size = struct.calcsize("<" + code)
        if self._leaves and size > self._leaves[0].size:
            self._close_run()
        offset = (self._leaves[-1].end + size - 1) & -size if self._leaves else 0
        self._leaves.append(Leaf(name, code, size, count, offset))

    def append(self, step: Text | Repeat) -> None:
        self._count()
        self._close_run()
        self._steps.append(step)

    def finish(self, build: Callable[[Iterator[Any]], Any]) -> Plan:
        self._close_run()
        plan = Plan(tuple(self._steps), build)
        if plan.least > MOST_BYTES:
            raise ConfigError(
                f"{self._owner}: its smallest message takes {plan.least} bytes; {MOST_BYTES} is the most"
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
        if size > MOST_BYTES:
            raise ConfigError(
                f"{self._owner}: its smallest message takes {size} bytes; {MOST_BYTES} is the most"
            )
        layout, position = "", 0
        for leaf in self._leaves:
            layout += f"{leaf.offset - position}x{'' if leaf.count is None else leaf.count}{leaf.code}"
            position = leaf.end
        structs = struct.Struct("<" + layout), struct.Struct(">" + layout)
        self._steps.append(Run(self._leaves[0].size, size, tuple(self._leaves), structs))
        self._leaves = []


def _empty(values: Iterator[Any]) -> dict[str, Any]:
    next(values)
    return {}
