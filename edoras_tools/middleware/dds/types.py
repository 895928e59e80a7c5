"""ROS message types as the classes that cyclonedds needs, made at run time.

The types are those that rmw_cyclonedds announces: final structs, ROS's member names, ``byte`` and ``char`` as
``uint8``. Cyclone DDS checks every sample against them, and other DDS programs can ask for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.names import dds_name
from edoras_tools.ros.types.schema import PLACEHOLDER, MessageField, Shape, full_name

if TYPE_CHECKING:
    from edoras_tools.ros.store import TypeStore

_PRIMITIVES: Final = {
    "bool": bool,
    "byte": idl.uint8,
    "char": idl.uint8,
    "int8": idl.int8,
    "uint8": idl.uint8,
    "int16": idl.int16,
    "uint16": idl.uint16,
    "int32": idl.int32,
    "uint32": idl.uint32,
    "int64": idl.int64,
    "uint64": idl.uint64,
    "float32": idl.float32,
    "float64": idl.float64,
}


class DdsTypes:
    """Makes the class of a ROS type, once.

    Args:
        types: knows the definitions.
    """

    def __init__(self, types: TypeStore) -> None:
        self._types = types
        self._made: dict[str, type[IdlStruct]] = {}

    def of(self, type_name: str) -> type[IdlStruct]:
        """Return the class of a message type.

        Raises:
            ConfigError: the type holds what cyclonedds for Python cannot say.
            RouteError: the type is not known.
        """
        name = full_name(type_name)
        if name not in self._made:
            members = {item.name: self._member(name, item) for item in self._types.fields(name)}
            dotted = dds_name(name).replace("::", ".")
            made: Any = make_idl_struct(
                dotted.rpartition(".")[2], dotted, members or {PLACEHOLDER: idl.uint8}, dataclassify=False
            )
            made.__init__ = _fill  # given by a base class, it would make that a base of the DDS type
            self._made[name] = made
        return self._made[name]

    def _member(self, owner: str, field: MessageField) -> Any:
        if field.type == "wstring":
            raise ConfigError(
                f"{owner}.{field.name}: cyclonedds for Python knows no wstring; use --ros zenoh for this type"
            )
        one: Any = _PRIMITIVES.get(field.type)
        if field.type == "string":
            one = Annotated[str, idl.bounded_str(field.string_bound)] if field.string_bound else str
        elif one is None:
            one = self.of(field.type)
        # as idl.array[one, size] and idl.sequence[one, size] do, but that the latter takes no more than 65535
        if field.shape is Shape.ARRAY:
            return Annotated[Sequence[one], idl.array(one, field.size)]
        if field.shape is Shape.SEQUENCE:
            return Annotated[Sequence[one], idl.sequence(one, field.size or None)]
        return one


def _fill(self: IdlStruct, **values: Any) -> None:
    """Hold any member, also one that Python has a keyword or cyclonedds a method for; dataclasses do not."""
    self.__dict__.update(values)
