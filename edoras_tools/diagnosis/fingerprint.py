"""Fingerprints of packets and of messages, for finding the same one again on another link.

A message's fingerprint is made of its decoded values, so that another encoding, padding and another time
stamp do not change it. Fingerprints are u64; 0 means that there is none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final
from zlib import crc32

import numpy as np

from edoras_tools.wire.window import gather

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.ros import TypeStore
    from edoras_tools.ros.columns import Ragged

_LONGEST: Final = 4096
"""Bytes of a packet that its fingerprint looks at; longer ones differ within them."""
_MIX: Final = np.uint64(0x9E3779B97F4A7C15)
_WEIGHTS: Final = np.random.default_rng(0xED02A5).integers(1, 1 << 63, _LONGEST // 8 + 1, np.uint64) * 2 + 1


def of_bytes(data: NDArray[np.uint8], offset: NDArray[np.int64], length: NDArray[Any]) -> NDArray[np.uint64]:
    """Return the fingerprint of each range of bytes, u64 (n,); 0 for an empty one."""
    out = np.zeros(len(offset), np.uint64)
    cut = np.minimum(length, _LONGEST)
    for size in np.unique(cut[cut > 0]).tolist():
        rows = np.flatnonzero(cut == size)
        window = np.ascontiguousarray(gather(data, offset[rows], -(-size // 8) * 8))
        window[:, size:] = 0
        words = window.view(np.uint64)
        total = length[rows].astype(np.uint64) * _MIX
        for column in range(words.shape[1]):
            total += _stirred(words[:, column]) * _WEIGHTS[column]
        out[rows] = _finished(total)
    return out


def of_values(
    types: TypeStore,
    type_name: str,
    data: NDArray[np.uint8],
    offset: NDArray[np.int64],
    length: NDArray[np.int32],
) -> tuple[NDArray[np.uint64], NDArray[np.uint64]]:
    """Return two fingerprints of each message: of all numbers but time stamps, and of all numbers.

    A type without numbers goes by its strings. Messages that do not decode have none.

    Args:
        types: the ROS types.
        type_name: of all the messages.
        data: u8, the buffer that holds them.
        offset: i64, first byte of each CDR, encapsulation included.
        length: i32, bytes of each CDR.
    """
    columns = types.columns(type_name, data, offset, length)
    plain, stamped = (np.zeros(len(columns), np.uint64) for _ in range(2))
    texts: list[tuple[str, Any]] = []
    counted = False
    for name, column in columns.fields.items():
        values = column if isinstance(column, np.ndarray) else column.values
        if values.dtype == object:
            texts.append((name, column))
            continue
        counted = True
        part = _field(name, column)
        stamped += part
        if not name.endswith(("stamp.sec", "stamp.nanosec")):
            plain += part
    if not counted:
        for name, column in texts:
            plain += _text(name, column)
        stamped = plain
    plain, stamped = _finished(plain), _finished(stamped)
    plain[~columns.valid], stamped[~columns.valid] = 0, 0
    return plain, stamped


def latest_equal(
    into: NDArray[np.uint64], into_ns: NDArray[np.int64], out: NDArray[np.uint64], out_ns: NDArray[np.int64]
) -> NDArray[np.intp]:
    """Return which of ``into`` is the latest equal to each of ``out`` and not later; -1 for none."""
    prints = np.concatenate((into, out))
    # What went in sorts before what comes out at the same time.
    side = np.repeat([0, 1], [len(into), len(out)])
    order = np.lexsort((side, np.concatenate((into_ns, out_ns)), prints))
    latest = np.maximum.accumulate(np.where(side[order] == 0, np.arange(len(order)), -1))
    goes = np.flatnonzero((side[order] == 1) & (latest >= 0))
    from_ = order[latest[goes]]
    same = (prints[order[goes]] == prints[from_]) & (prints[from_] != 0)
    found = np.full(len(out), -1, np.intp)
    found[order[goes[same]] - len(into)] = from_[same]
    return found


def _field(name: str, column: NDArray[Any] | Ragged) -> NDArray[np.uint64]:
    """Return what a numeric field adds to the fingerprints, a row each."""
    key = np.uint64(crc32(name.encode()) * int(_MIX) & 0xFFFFFFFFFFFFFFFF)
    if isinstance(column, np.ndarray):
        flat = column.reshape(len(column), -1)
        total = np.zeros(len(column), np.uint64)
        for index in range(flat.shape[1]):
            total += _stirred(_bits(flat[:, index]) + key) * _WEIGHTS[index % len(_WEIGHTS)]
        return total
    count = np.diff(column.offsets)
    within = np.arange(len(column.values)) - np.repeat(column.offsets[:-1], count)
    part = _stirred(_bits(column.values) + key) * _WEIGHTS[within % len(_WEIGHTS)]
    sums = np.concatenate((np.zeros(1, np.uint64), np.cumsum(part, dtype=np.uint64)))
    total = sums[column.offsets[1:]] - sums[column.offsets[:-1]] + count.astype(np.uint64) * key
    return np.asarray(total, np.uint64)


def _text(name: str, column: NDArray[Any] | Ragged) -> NDArray[np.uint64]:
    key = name.encode()
    rows = (
        column.tolist()
        if isinstance(column, np.ndarray)
        else ["\0".join(column[row].tolist()) for row in range(len(column))]
    )
    return np.array([crc32(text.encode("utf-8", "replace"), crc32(key)) for text in rows], np.uint64) * _MIX


def _bits(values: NDArray[Any]) -> NDArray[np.uint64]:
    if values.dtype.kind == "f":
        # 0.0 and -0.0 are one value.
        return (values.astype(np.float64) + 0.0).view(np.uint64)
    return values.astype(np.int64).view(np.uint64)


def _stirred(words: NDArray[np.uint64]) -> NDArray[np.uint64]:
    mixed = (words ^ (words >> np.uint64(29))) * _MIX
    return np.asarray(mixed ^ (mixed >> np.uint64(32)), np.uint64)


def _finished(total: NDArray[np.uint64]) -> NDArray[np.uint64]:
    return _stirred(total) | np.uint64(1)
