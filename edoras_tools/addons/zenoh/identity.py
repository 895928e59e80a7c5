"""Identities in rmw_zenoh: keys of topics, tokens of entities, the sender's id in each message.

A topic's key contains domain, type and type hash, so that incompatible entities do not communicate. A token
announces that an entity exists; ``ros2 topic list`` is made of tokens. Both follow rmw_zenoh's design
(https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md).

A publisher's id is the XXH3 hash, 128 bits, of its token, so that everybody who sees the token can compute
the id, and find the sender of a message in the graph. The hash is the public algorithm
(https://github.com/Cyan4973/xxHash/blob/dev/doc/xxhash_spec.md) with seed 0 and the default secret, for more
than 16 bytes: a token is always longer. The id is in the attachment of each message, with time and sequence
number.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

from edoras_tools.errors import FieldError, TruncatedError, WireError
from edoras_tools.middleware.names import dds_name, node_name
from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.middleware.graph import Qos

NO_TYPE_HASH: Final = "TypeHashNotSupported"
"""The type hash that rmw_zenoh writes in Humble, which has none."""
DEFAULT_DEPTH: Final = 42
"""The default depth of rmw_zenoh."""


class TokenKind(StrEnum):
    """The kind of entity that a liveliness token announces."""

    NODE = "NN"
    PUBLISHER = "MP"
    SUBSCRIPTION = "MS"


class KeyedTopic(NamedTuple):
    """A topic, with its type and type hash.

    Attributes:
        name: fully qualified, ``/cmd_vel``.
        type: ROS name, ``geometry_msgs/msg/Twist``.
        type_hash: ``RIHS01_`` and 64 digits, or ``NO_TYPE_HASH``.
    """

    name: str
    type: str
    type_hash: str

    @property
    def dds_type(self) -> str:
        """The type as DDS names it, ``geometry_msgs::msg::dds_::Twist_``."""
        return dds_name(self.type)

    def key(self, domain: int) -> str:
        """Return the key expression of the topic's messages."""
        return f"{domain}/{self.name.strip('/')}/{self.dds_type}/{self.type_hash}"


class NodeTokens(msgspec.Struct, frozen=True):
    """A node, and the tokens of the node and its entities.

    Attributes:
        domain: ``ROS_DOMAIN_ID``.
        session: id of the Zenoh session, hexadecimal.
        namespace: ``/`` or ``/robot``.
        name: name without its namespace.
        id: id of the node within its session.
    """

    domain: int
    session: str
    namespace: str
    name: str
    id: int = 0

    @classmethod
    def of_node(cls, name: str, domain: int, session: str) -> Self:
        """Return a node from ``name``, or ``/namespace/name``.

        Raises:
            ConfigError: it is not a valid name of a node.
        """
        return cls(domain, session, *node_name(name))

    @property
    def token(self) -> str:
        """The token of the node itself."""
        return self._token(TokenKind.NODE, self.id)

    def entity_token(self, kind: TokenKind, entity: int, topic: KeyedTopic, qos: Qos) -> str:
        """Return the token of a publisher or a subscription.

        Args:
            entity: id of the entity within the session.
            qos: requested quality of service.
        """
        return "/".join(
            [self._token(kind, entity), _mangled(topic.name), topic.dds_type, topic.type_hash, qos_text(qos)]
        )

    def _token(self, kind: TokenKind, entity: int) -> str:
        enclave = _mangled("/")
        who = f"{enclave}/{_mangled(self.namespace)}/{self.name}"
        return f"@ros2_lv/{self.domain}/{self.session}/{self.id}/{entity}/{kind}/{who}"


def depth(qos: Qos) -> int:
    """Return the size of a cache in samples; for "keep all", ROS leaves it to the middleware."""
    return qos.depth or DEFAULT_DEPTH


def qos_text(qos: Qos) -> str:
    """Return a quality of service in the form of tokens: numbers of rmw's enumerations, empty for a default.

    The order is reliability, durability, history and depth, deadline, lifespan, liveliness and its lease; the
    parts behind the depth are never set here.
    """
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.transient_local else ""
    history = "" if qos.depth else "2"
    size = "" if depth(qos) == DEFAULT_DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:{history},{size}:,:,:,,"


def _mangled(name: str) -> str:
    """Return a name as one chunk of a key."""
    return name.replace("/", "%")


_WORD: Final = 2**64 - 1
_PRIME32: Final = 0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D
_PRIME64: Final = (
    0x9E3779B185EBCA87,
    0xC2B2AE3D27D4EB4F,
    0x165667B19E3779F9,
    0x85EBCA77C2B2AE63,
    0x27D4EB2F165667C5,
)
_AVALANCHE: Final = 0x165667919E3779F9
_SECRET: Final = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671f"
    "cb79e64eccc0e578825ad07dccff7221b8084674f743248ee03590e6813a264c"
    "3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8"
    "a8fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364"
    "eac5ac8334d3ebc3c581a0fffa1363eb170ddd51b7f0da49d316552629d4689e"
    "2b16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
_LEAST: Final = 17
_SHORT: Final = 128
_MIDDLE: Final = 240
_LANES: Final = 8
_STRIPE: Final = 64
_STRIPES: Final = (len(_SECRET) - _STRIPE) // 8
"""Stripes of a block; after each block the lanes are scrambled."""

_Pair = tuple[int, int]


def gid(token: str) -> bytes:
    """Return the 16 bytes that identify the entity of a liveliness token."""
    low, high = xxh3(token.encode())
    return low.to_bytes(8, "little") + high.to_bytes(8, "little")


def xxh3(data: bytes) -> _Pair:
    """Return the low and the high half of the hash of at least 17 bytes."""
    assert len(data) >= _LEAST
    if len(data) > _MIDDLE:
        return _long(data)
    pair = len(data) * _PRIME64[0] & _WORD, 0
    if len(data) <= _SHORT:
        for step in reversed(range((len(data) - 1) // 32 + 1)):
            pair = _mix(pair, data, 16 * step, len(data) - 16 * (step + 1), 32 * step)
    else:
        for step in range(4):
            pair = _mix(pair, data, 32 * step, 32 * step + 16, 32 * step)
        pair = _avalanche(pair[0]), _avalanche(pair[1])
        for step in range(4, len(data) // 32):
            pair = _mix(pair, data, 32 * step, 32 * step + 16, 3 + 32 * (step - 4))
        pair = _mix(pair, data, len(data) - 16, len(data) - 32, 103)
    low, high = pair
    folded = low * _PRIME64[0] + high * _PRIME64[3] + len(data) * _PRIME64[1]
    return _avalanche(low + high & _WORD), -_avalanche(folded & _WORD) & _WORD


def _long(data: bytes) -> _Pair:
    lanes = [_PRIME32[2], *_PRIME64[:4], _PRIME32[1], _PRIME64[4], _PRIME32[0]]
    last = len(_SECRET) - _STRIPE
    for stripe in range((len(data) - 1) // _STRIPE):
        place = stripe % _STRIPES
        if stripe and not place:
            lanes = _scrambled(lanes, last)
        _accumulate(lanes, data, stripe * _STRIPE, place * 8)
    if (len(data) - 1) // _STRIPE % _STRIPES == 0:
        lanes = _scrambled(lanes, last)
    _accumulate(lanes, data, len(data) - _STRIPE, last - 7)
    return (
        _merged(lanes, 11, len(data) * _PRIME64[0] & _WORD),
        _merged(lanes, last - 11, ~(len(data) * _PRIME64[1]) & _WORD),
    )


def _accumulate(lanes: list[int], data: bytes, start: int, secret: int) -> None:
    for lane in range(_LANES):
        value = _read(data, start + 8 * lane)
        keyed = value ^ _read(_SECRET, secret + 8 * lane)
        lanes[lane ^ 1] = lanes[lane ^ 1] + value & _WORD
        lanes[lane] = lanes[lane] + (keyed & 0xFFFFFFFF) * (keyed >> 32) & _WORD


def _scrambled(lanes: list[int], secret: int) -> list[int]:
    return [
        (value ^ value >> 47 ^ _read(_SECRET, secret + 8 * lane)) * _PRIME32[0] & _WORD
        for lane, value in enumerate(lanes)
    ]


def _merged(lanes: list[int], secret: int, start: int) -> int:
    for lane in range(0, _LANES, 2):
        first = lanes[lane] ^ _read(_SECRET, secret + 8 * lane)
        start += _folded(first, lanes[lane + 1] ^ _read(_SECRET, secret + 8 * lane + 8))
    return _avalanche(start & _WORD)


def _mix(pair: _Pair, data: bytes, first: int, second: int, secret: int) -> _Pair:
    """Mix two pieces of 16 bytes into both halves, keyed by 32 bytes of the secret."""
    low, high = pair
    low = low + _keyed(data, first, secret) & _WORD
    low ^= _read(data, second) + _read(data, second + 8) & _WORD
    high = high + _keyed(data, second, secret + 16) & _WORD
    high ^= _read(data, first) + _read(data, first + 8) & _WORD
    return low, high


def _keyed(data: bytes, start: int, secret: int) -> int:
    first = _read(data, start) ^ _read(_SECRET, secret)
    return _folded(first, _read(data, start + 8) ^ _read(_SECRET, secret + 8))


def _folded(first: int, second: int) -> int:
    product = first * second
    return product & _WORD ^ product >> 64


def _avalanche(value: int) -> int:
    value = (value ^ value >> 37) * _AVALANCHE & _WORD
    return value ^ value >> 32


def _read(data: bytes, start: int) -> int:
    return int.from_bytes(data[start : start + 8], "little")


GID: Final = 16
"""Bytes of a publisher's id."""
ATTACHMENT: Final = struct.Struct(f"<qqB{GID}s")
"""Sequence number, source time in ns, length of the id (one byte of Zenoh's variable-length numbers), id."""


class Attachment(msgspec.Struct, frozen=True):
    """The attachment of a message, 33 bytes, little-endian.

    Attributes:
        sequence_number: i64, starts at 1 and grows by 1 with each message of a publisher.
        source_timestamp: i64, ns since 1970-01-01 UTC.
        source_gid: the publisher's id, 16 bytes.
    """

    sequence_number: int
    source_timestamp: int
    source_gid: bytes

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read an attachment.

        Raises:
            TruncatedError: there are fewer bytes.
            FieldError: the id is of another length.
            WireError: there are more bytes.
        """
        if len(data) < ATTACHMENT.size:
            raise TruncatedError("attachment", 0, ATTACHMENT.size, len(data))
        sequence_number, source_timestamp, size, gid = ATTACHMENT.unpack_from(data)
        if size != GID:
            raise FieldError("attachment", "source_gid", f"{size} bytes are announced; an id has {GID}")
        if len(data) > ATTACHMENT.size:
            raise WireError(
                f"attachment: {len(data) - ATTACHMENT.size} bytes follow the id; {ATTACHMENT.size} is all"
            )
        return cls(sequence_number, source_timestamp, gid)

    def emit(self) -> bytes:
        """Return the attachment's bytes.

        Raises:
            FieldError: a number needs more than 64 bits, or the id is not of 16 bytes.
        """
        if len(self.source_gid) != GID:
            raise FieldError("attachment", "source_gid", f"{len(self.source_gid)} bytes; an id has {GID}")
        for name in ("sequence_number", "source_timestamp"):
            if not -(2**63) <= getattr(self, name) < 2**63:
                raise FieldError("attachment", name, f"{getattr(self, name)} exceeds 64 bits")
        return ATTACHMENT.pack(self.sequence_number, self.source_timestamp, GID, self.source_gid)
