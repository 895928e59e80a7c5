"""The interface to ROS messages: types, definitions, and CDR to values and back, for one message or many.

``types_that_fit`` finds the types that messages of unknown type may have.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools.errors import ConfigError, EdorasError, RouteError
from edoras_tools.ros import library
from edoras_tools.ros.cdr.plan import ROUNDING, CdrPlan, Compiler
from edoras_tools.ros.cdr.values import ENCAPSULATION_BYTES, ValueSpan, Writer, decode, value_spans
from edoras_tools.wire.arrays import Integers, Mask, Octets, by_key

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from edoras_tools.ros.cdr.bulk import MessageColumns

USUAL_DISTRO: Final = "jazzy"
"""The distribution if none is named: that of EDORAS's own images."""


class TypeStore:
    """Knows message types; reads and writes their CDR.

    It is fast to create: a distribution's messages are loaded when the first type is used. ``pkg/Name`` is
    accepted for ``pkg/msg/Name``. Methods that take a type raise ``RouteError``, with the nearest names, if
    the type is not known, and ``ConfigError`` if its definition has mistakes.

    Args:
        distro: ROS 2 distribution, as ``jazzy``; ``rolling`` and ``latest`` are the newest one known.
        msg_paths: folders or files with more definitions, laid out ``PACKAGE/msg/NAME.msg`` or ``.idl``.
        definitions: complete ``ros2msg`` texts by type, as the schemas of an MCAP.

    Attributes:
        distro: the distribution, as given.

    Raises:
        ConfigError: the distribution or a folder does not exist, or a folder holds no definition.
    """

    def __init__(
        self,
        distro: str = USUAL_DISTRO,
        msg_paths: Iterable[str | os.PathLike[str]] = (),
        definitions: Mapping[str, str] | None = None,
    ) -> None:
        self.distro = distro
        self._library = library.Library(distro, msg_paths, definitions or {})
        self._compiler = Compiler(self._definition)
        self._writers = tuple(Writer(self._definition, big_endian=big) for big in (False, True))
        self._plans: dict[str, tuple[str, CdrPlan]] = {}

    def has(self, type_name: str) -> bool:
        """Return whether a type is known and, with all types that it uses, free of mistakes."""
        return self.check(type_name) is None

    def check(self, type_name: str) -> str | None:
        """Return the reason why a type cannot be used, in one sentence; None if it can."""
        try:
            self.plan(type_name)
        except (ConfigError, RouteError) as error:
            return str(error).partition("\n")[0]
        return None

    def nearest(self, type_name: str) -> list[str]:
        """Return the most similar known type names, best first, at most three."""
        package, _, last = type_name.rpartition("/")
        by_last = by_key(self.types(), lambda name: name.rpartition("/")[2].lower())
        close = get_close_matches(last.lower(), by_last, 3, 0.6)
        package = package.partition("/")[0] + "/"
        return [
            name for part in close for name in sorted(by_last[part], key=lambda name: package not in name)
        ][:3]

    def types(self) -> list[str]:
        """Return the names of all types that can be found, sorted."""
        return self._library.names()

    def definition(self, type_name: str) -> str:
        """Return a type's ``ros2msg`` text with the types that it uses, as in an MCAP schema."""
        return library.complete_text(self.definitions(type_name))

    def definitions(self, type_name: str) -> tuple[library.Definition, ...]:
        """Return a type's definition, then the definitions of all types that it uses, each once."""
        self.plan(type_name)
        return library.with_used(library.full_name(type_name), self._definition)

    def fields(self, type_name: str) -> tuple[library.MessageField, ...]:
        """Return a type's fields, in wire order; a field of another type stays one field of that type."""
        self.plan(type_name)
        return self._definition(library.full_name(type_name)).fields

    def decode(self, type_name: str, cdr: bytes) -> dict[str, Any]:
        """Return a message as plain values: dicts, lists, int, float, bool, str.

        A sequence of ``uint8``, ``byte`` or ``char``, such as the data of an image, is ``bytes`` that are
        equal to the list of their numbers.

        Args:
            cdr: encapsulation and body, in either byte order.

        Raises:
            WireError: the message is not valid; the error names the field, its place and what it needs.
        """
        name, plan = self.plan(type_name)
        return decode(name, plan, bytes(cdr))

    def spans(self, type_name: str, cdr: bytes) -> list[ValueSpan]:
        """Return every leaf of a message as (dotted path, value, start, end).

        Offsets count from the start of ``cdr``. An array or a sequence of primitives is one leaf, count
        included.

        Raises:
            WireError: as ``decode``.
        """
        return value_spans(*self.plan(type_name), bytes(cdr))

    def encode(self, type_name: str, values: Mapping[str, Any], *, big_endian: bool = False) -> bytes:
        """Return a message from plain values, encapsulation included.

        Missing fields take their defaults. Tuples and arrays are accepted as lists, bytes as lists of bytes.

        Raises:
            FieldError: a value does not fit or a field does not exist; the error names the path and what it
                takes.
        """
        name, _ = self.plan(type_name)
        return self._writers[big_endian].encode(name, values)

    def fixed_size(self, type_name: str) -> int | None:
        """Return the bytes of every message of a type, encapsulation included; None if the size varies."""
        size = self.plan(type_name)[1].fixed_size
        return None if size is None else ENCAPSULATION_BYTES + size

    def extent(self, type_name: str, cdr: bytes) -> int:
        """Return the bytes of one message with its encapsulation, without the bytes after its last field.

        Its values are not checked; ``decode`` does that.

        Raises:
            WireError: the message ends before its last field does, or is not CDR.
        """
        from edoras_tools.ros.cdr.bulk import extent

        return extent(*self.plan(type_name), cdr)

    def valid(self, type_name: str, data: Octets, offset: Integers, length: NDArray[np.int32]) -> Mask:
        """Return which of many messages ``decode`` accepts.

        Args:
            data: u8, the buffer that holds them.
            offset: i64, first byte of each message, encapsulation included; any value is safe.
            length: i32, bytes of each message; any value is safe.
        """
        return self.trailing(type_name, data, offset, length) >= 0

    def trailing(
        self, type_name: str, data: Octets, offset: Integers, length: NDArray[np.int32]
    ) -> NDArray[np.int32]:
        """Return the bytes after the last field of each of many messages; -1 for messages that are not valid.

        Arguments as ``valid``. ``most_trailing`` returns the usual maximum.
        """
        from edoras_tools.ros.cdr import bulk

        return bulk.trailing(self.plan(type_name)[1], data, offset, length)

    def most_trailing(self, type_name: str) -> int:
        """Return the most bytes that a writer of ROS 2 leaves after the last field of a type."""
        return self.plan(type_name)[1].most_trailing

    def columns(
        self, type_name: str, data: Octets, offset: Integers, length: NDArray[np.int32]
    ) -> MessageColumns:
        """Return the fields of many messages as columns, one a field; arguments as ``valid``."""
        from edoras_tools.ros.cdr import bulk

        return bulk.columns(*self.plan(type_name), data, offset, length)

    def plan(self, type_name: str) -> tuple[str, CdrPlan]:
        """Return a type's full name, and the plan from which all of its readers are made.

        Raises:
            ConfigError: a definition has a mistake.
            RouteError: the type, or one that it uses, is not known.
        """
        entry = self._plans.get(type_name)
        if entry is None:
            name = library.full_name(type_name)
            entry = self._plans[type_name] = name, self._compiler.plan(name)
        return entry

    def _definition(self, name: str) -> library.Definition:
        definition = self._library.find(name)
        if definition is None:
            near = " or ".join(self.nearest(name))
            hint = f"did you mean {near}? If not, " if near else ""
            hint += "give its definition with --set msg-path"
            raise RouteError(f"type {name!r} is not known to ROS 2 {self.distro}; {hint}")
        return definition


PACKAGES: Final = ("geometry_msgs", "sensor_msgs", "std_msgs", "nav_msgs", "builtin_interfaces")
"""Packages whose types are tried, besides the types that the caller names."""
USUAL: Final = (
    "geometry_msgs/msg/Pose",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/Twist",
    "sensor_msgs/msg/JointState",
)
"""Types that the EDORAS demos send: more likely than another type of the same shape."""


def types_that_fit(types: TypeStore, samples: Collection[bytes], own: Collection[str] = ()) -> list[str]:
    """Return the types whose last field ends every sample, or leaves at most their ``excess`` after it.

    Args:
        types: the type store.
        samples: CDR of the messages, encapsulation included.
        own: types to try besides those of ``PACKAGES``; they come first in the result, then ``USUAL``.
    """
    return types_that_fit_each(types, [samples], own)[0]


def types_that_fit_each(
    types: TypeStore, groups: Sequence[Collection[bytes]], own: Collection[str] = ()
) -> list[list[str]]:
    """Return the result of ``types_that_fit`` for each group of samples; no types for an empty group."""
    some = [group for group in groups if group]
    if not some:
        return [[] for _ in groups]
    cdrs = [cdr for group in some for cdr in group]
    length = np.array([len(cdr) for cdr in cdrs], np.int32)
    offset = np.cumsum(length, dtype=np.int64) - length
    data, begins = np.frombuffer(b"".join(cdrs), np.uint8), np.cumsum([0, *map(len, some[:-1])])
    names = {name for name in types.types() if name.startswith(tuple(f"{item}/msg/" for item in PACKAGES))}
    fits: list[list[str]] = [[] for _ in some]
    for name in sorted({*names, *own}, key=lambda name: (name not in own, name not in USUAL, name)):
        with suppress(EdorasError):
            size, most = types.fixed_size(name), types.most_trailing(name) - ROUNDING
            if size and not np.logical_and.reduceat((size <= length) & (length <= size + most), begins).any():
                continue  # the case of most types: each group has a message of another size
            behind = types.trailing(name, data, offset, length)
            ends = (behind >= 0) & (behind <= most)
            for place in np.flatnonzero(np.logical_and.reduceat(ends, begins)).tolist():
                fits[place].append(name)
    lists = iter(fits)
    return [next(lists) if group else [] for group in groups]
