"""Samples as bytes, in and out of Cyclone DDS, past the Python objects that cyclonedds makes of them.

A sample of a topic made in Python is its bytes already: ``dds_write`` takes a pointer and a size for it, and
``ddspy_take`` gives bytes. Both are internal to cyclonedds, so only this file uses them; where they are not
as expected, the public functions (to objects and back) do the same, slower.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any, Final

from cyclonedds.core import DDSException, InstanceState, SampleState, ViewState
from cyclonedds.internal import DDS, InvalidSample

if TYPE_CHECKING:
    from collections.abc import Callable

    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

    Write = Callable[[bytes], int]
    Take = Callable[[], list[bytes]]

_MOST_SAMPLES: Final = 256
"""Most samples taken at once: one topic must not keep the others waiting."""
ANY_STATE: Final = SampleState.Any | ViewState.Any | InstanceState.Any
"""Samples in any state: the mask for taking samples and for the wait set."""


class _Sample(ctypes.Structure):
    _fields_ = (("data", ctypes.c_char_p), ("size", ctypes.c_size_t))


def writer_of(writer: DataWriter[Any]) -> Write:
    """Return what writes one sample: encapsulation and body, padded to 4; it returns a ``DDS_RETCODE``.

    Other Python threads run while a write waits for space.
    """
    try:
        prototype = ctypes.CFUNCTYPE(ctypes.c_int32, ctypes.c_int32, ctypes.POINTER(_Sample))
        dds_write = prototype(("dds_write", DDS._dll_handle))  # noqa: SLF001  see above
        entity = writer._ref  # noqa: SLF001
    except AttributeError:
        return plain_writer_of(writer)
    return lambda cdr: dds_write(entity, _Sample(cdr, len(cdr)))


def taker_of(reader: DataReader[Any]) -> Take:
    """Return what takes the samples that wait, ``_MOST_SAMPLES`` at most: encapsulation, body, padding."""
    try:
        from cyclonedds._clayer import ddspy_take  # type: ignore[import-not-found]

        entity = reader._ref  # noqa: SLF001
        if isinstance(ddspy_take(entity, ANY_STATE, _MOST_SAMPLES), int):
            return plain_taker_of(reader)
    except (ImportError, AttributeError, TypeError):
        return plain_taker_of(reader)

    def take() -> list[bytes]:
        taken = ddspy_take(entity, ANY_STATE, _MOST_SAMPLES)
        if isinstance(taken, int):
            raise DDSException(taken, "while taking samples")
        return [data for data, info in taken if info.valid_data]

    return take


def plain_writer_of(writer: DataWriter[Any]) -> Write:
    """Return ``writer_of``'s like from public parts only."""
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


def plain_taker_of(reader: DataReader[Any]) -> Take:
    """Return ``taker_of``'s like from public parts only."""
    of = reader.topic.data_type.__idl__
    return lambda: [
        of.serialize(sample) for sample in reader.take(_MOST_SAMPLES) if not isinstance(sample, InvalidSample)
    ]
