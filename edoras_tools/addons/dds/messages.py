"""Messages in Cyclone DDS: classes of their types, reading and writing their bytes, and RTPS's padding.

**Types.** They are equal to those of rmw_cyclonedds: final structs, ROS's member names, ``byte`` and
``char`` as ``uint8``. Cyclone DDS checks every sample against them, and other DDS programs can request them.

**Bytes.** For a topic made in Python a sample is already bytes: ``dds_write`` takes a pointer and a size, and
``ddspy_take`` returns bytes. Both are internal to cyclonedds, so only this file uses them. If they are not as
expected, the public functions (to objects and back) do the same, slower.

**Padding.** CDR in RTPS is padded to 4 bytes, here little-endian, with the number of padding bytes in the
two low bits of the options (DDS-XTypes 1.3, 7.6.3.1.2). Not all writers set them.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

from cyclonedds.core import DDSException, InstanceState, SampleState, ViewState
from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.internal import DDS, InvalidSample

from edoras_tools.errors import ConfigError
from edoras_tools.middleware.graph import dds_name
from edoras_tools.ros.library import PLACEHOLDER, MessageField, Shape, full_name

if TYPE_CHECKING:
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

    from edoras_tools.ros import TypeStore

    Write = Callable[[bytes], int]
    TakeWithInfo = Callable[[], list[tuple[bytes, Any]]]

_PRIMITIVES: Final = {
    "bool": bool,
    "byte": idl.uint8,
    "char": idl.uint8,
    "float32": idl.float32,
    "float64": idl.float64,
    **{
        f"{kind}{bits}": getattr(idl, f"{kind}{bits}") for kind in ("int", "uint") for bits in (8, 16, 32, 64)
    },
}


class DdsTypes:
    """Makes the class of a ROS type, once.

    Args:
        types: store with the definitions.
    """

    def __init__(self, types: TypeStore) -> None:
        self._types = types
        self._made: dict[str, type[IdlStruct]] = {}

    def of(self, type_name: str) -> type[IdlStruct]:
        """Return the class of a message type.

        Raises:
            ConfigError: the type has a part that cyclonedds for Python cannot express.
            RouteError: the type is not known.
        """
        name = full_name(type_name)
        if name not in self._made:
            members = {item.name: self._member(name, item) for item in self._types.fields(name)}
            dotted = dds_name(name).replace("::", ".")
            data_type: Any = make_idl_struct(
                dotted.rpartition(".")[2], dotted, members or {PLACEHOLDER: idl.uint8}, dataclassify=False
            )
            data_type.__init__ = _fill  # a base class with it would become a base of the DDS type
            self._made[name] = data_type
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
        # like idl.array[one, size] and idl.sequence[one, size], but the latter takes no more than 65535
        if field.shape is Shape.ARRAY:
            return Annotated[Sequence[one], idl.array(one, field.size)]
        if field.shape is Shape.SEQUENCE:
            return Annotated[Sequence[one], idl.sequence(one, field.size or None)]
        return one


def _fill(self: IdlStruct, **values: Any) -> None:
    """Store all members, also with names of Python keywords or cyclonedds methods; dataclasses cannot."""
    self.__dict__.update(values)


_MOST_SAMPLES: Final = 256
"""Most samples taken at once: one topic must not keep the others waiting."""
ANY_STATE: Final = SampleState.Any | ViewState.Any | InstanceState.Any
"""Samples in any state: the mask for taking samples and for the wait set."""


class _Sample(ctypes.Structure):
    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t))


def writer_of(writer: DataWriter[Any]) -> Write:
    """Return a function that writes a sample with encapsulation, padded to 4; it returns a ``DDS_RETCODE``.

    Other Python threads run while a write waits for space.
    """
    try:
        prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_int32, ctypes.POINTER(_Sample))
        dds_write = prototype(("dds_write", DDS._dll_handle))  # noqa: SLF001  see above
        entity = writer._ref  # noqa: SLF001
    except AttributeError:
        return plain_writer_of(writer)
    return lambda cdr: dds_write(entity, _Sample(cdr, len(cdr)))


def info_taker_of(reader: DataReader[Any]) -> TakeWithInfo:
    """Return a function that takes the waiting samples, at most ``_MOST_SAMPLES``, each with ``SampleInfo``.

    A sample is encapsulation, body and padding.
    """
    try:
        from cyclonedds._clayer import ddspy_read, ddspy_take  # type: ignore[import-not-found]

        entity = reader._ref  # noqa: SLF001
        if isinstance(ddspy_read(entity, ANY_STATE, 1), int):  # a sample may already be there
            return plain_taker_of(reader)
    except (ImportError, AttributeError, TypeError):
        return plain_taker_of(reader)

    def take() -> list[tuple[bytes, Any]]:
        samples = ddspy_take(entity, ANY_STATE, _MOST_SAMPLES)
        if isinstance(samples, int):
            raise DDSException(samples, "while taking samples")
        return [item for item in samples if item[1].valid_data]

    return take


def plain_writer_of(writer: DataWriter[Any]) -> Write:
    """Return a function like that of ``writer_of``, made of public parts only."""
    of = writer.topic.data_type.__idl__

    def write(cdr: bytes) -> int:
        try:
            writer.write(of.deserialize(cdr))
        except DDSException as error:
            return error.code
        except Exception:  # noqa: BLE001  cyclonedds tells of bytes that do not fit by whatever went wrong
            return DDSException.DDS_RETCODE_BAD_PARAMETER
        return DDSException.DDS_RETCODE_OK

    return write


def plain_taker_of(reader: DataReader[Any]) -> TakeWithInfo:
    """Return a function like that of ``info_taker_of``, made of public parts only."""
    of = reader.topic.data_type.__idl__
    return lambda: [
        (of.serialize(sample), sample.sample_info)
        for sample in reader.take(_MOST_SAMPLES)
        if not isinstance(sample, InvalidSample)
    ]


_LITTLE: Final = b"\x00\x01"
"""Representation of little-endian CDR, as ROS 2 sends it."""
_PAD_BITS: Final = 3


def is_little_endian(cdr: bytes) -> bool:
    """Return whether a message is little-endian CDR and has a body."""
    return cdr[:2] == _LITTLE and len(cdr) > 4


def padded(cdr: bytes) -> bytes:
    """Return a message as little-endian CDR, padded to a multiple of 4 bytes as RTPS requires."""
    extra = -len(cdr) % 4
    return cdr if not extra else _LITTLE + bytes((0, extra)) + cdr[4:] + bytes(extra)


def trimmed(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a valid message without its padding, as it was before writing.

    Args:
        types: store with the type.
        type_name: type of the message.
        cdr: message as received.
    """
    if extra := cdr[3] & _PAD_BITS:
        return cdr[:3] + bytes((cdr[3] ^ extra,)) + cdr[4:-extra]
    if cdr[-1] or len(cdr) == types.fixed_size(type_name):
        return cdr
    end = types.extent(type_name, cdr)
    return cdr[:end] if len(cdr) - end <= _PAD_BITS else cdr


def rewritten(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a message as ROS 2 itself writes it: Cyclone DDS accepts fewer forms than our reader.

    Raises:
        WireError: it is not a valid message of its type.
    """
    return types.encode(type_name, types.decode(type_name, cdr))
