"""CDR in RTPS: padded to 4 bytes, the number of padding bytes in the options, little-endian here.

The options' two low bits are DDS-XTypes 1.3, 7.6.3.1.2. Not all writers set them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from edoras_tools.ros import TypeStore

_LITTLE: Final = b"\x00\x01"
"""The representation of little-endian CDR, as ROS 2 sends it."""
_PAD_BITS: Final = 3


def is_little_endian(cdr: bytes) -> bool:
    """Tell whether a message is little-endian CDR and has a body."""
    return cdr[:2] == _LITTLE and len(cdr) > 4


def padded(cdr: bytes) -> bytes:
    """Return a message as little-endian CDR, padded to a multiple of 4 bytes as RTPS requires."""
    extra = -len(cdr) % 4
    return cdr if not extra else _LITTLE + bytes((0, extra)) + cdr[4:] + bytes(extra)


def trimmed(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a valid message without its padding, as it was before it was written.

    Args:
        types: has the type.
        type_name: of the message.
        cdr: as received.
    """
    if extra := cdr[3] & _PAD_BITS:
        return cdr[:3] + bytes((cdr[3] ^ extra,)) + cdr[4:-extra]
    if cdr[-1] or len(cdr) == types.fixed_size(type_name):
        return cdr
    end = types.extent(type_name, cdr)
    return cdr[:end] if len(cdr) - end <= _PAD_BITS else cdr


def rewritten(types: TypeStore, type_name: str, cdr: bytes) -> bytes:
    """Return a message as ROS 2 itself writes it: Cyclone DDS accepts less than our reader does.

    Raises:
        WireError: it is not a valid message of its type.
    """
    return types.encode(type_name, types.decode(type_name, cdr))
