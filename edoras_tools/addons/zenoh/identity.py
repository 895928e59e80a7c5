"""Identities in rmw_zenoh: keys of topics, tokens of entities, the sender's id in each message.

A topic's key contains domain, type and type hash, so that incompatible entities do not communicate. A token
announces that an entity exists; ``ros2 topic list`` is made of tokens. Both follow rmw_zenoh's design
(https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md).

A publisher's id is the XXH3 hash, 128 bits, of its token, the least significant byte first. So everybody who
sees the token can compute the id, and find the sender of a message in the graph. The id is in the attachment
of each message, with time and sequence number.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import xxhash

from edoras_tools.middleware.graph import Qos, dds_name, node_name
from edoras_tools.older import StrEnum

if TYPE_CHECKING:
    from typing_extensions import Self


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
    """

    domain: int
    session: str
    namespace: str
    name: str

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
        return self._token(TokenKind.NODE, 0)

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
        """Return the beginning of a token; the node is the first of its session, in the enclave ``/``."""
        who = f"{_mangled('/')}/{_mangled(self.namespace)}/{self.name}"
        return f"@ros2_lv/{self.domain}/{self.session}/0/{entity}/{kind}/{who}"


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


def gid(token: str) -> bytes:
    """Return the 16 bytes that identify the entity of a liveliness token."""
    return xxhash.xxh3_128_digest(token.encode())[::-1]


GID: Final = 16
"""Bytes of a publisher's id."""
ATTACHMENT: Final = struct.Struct(f"<qqB{GID}s")
"""Sequence number, source time in ns, length of the id (one byte of Zenoh's variable-length numbers), id."""
