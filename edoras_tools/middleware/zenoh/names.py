"""Names in rmw_zenoh: key expressions of topics, and liveliness tokens of the entities of a graph.

A topic's key contains domain, type and type hash, so that incompatible entities do not communicate. A token
announces that an entity exists; ``ros2 topic list`` is made of tokens. Both follow rmw_zenoh's design
(https://github.com/ros2/rmw_zenoh/blob/rolling/docs/design.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

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
    """A topic, and its key.

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


@dataclass(frozen=True, slots=True)
class NodeTokens:
    """A node, and the tokens of the node and its entities.

    Attributes:
        domain: ``ROS_DOMAIN_ID``.
        session: the Zenoh session's id, hexadecimal.
        namespace: ``/`` or ``/robot``.
        name: without its namespace.
        id: of the node within its session.
    """

    domain: int
    session: str
    namespace: str
    name: str
    id: int = 0

    @classmethod
    def named(cls, name: str, domain: int, session: str) -> Self:
        """Return a node from ``name``, or ``/namespace/name``.

        Raises:
            ConfigError: it is not a name for a node.
        """
        return cls(domain, session, *node_name(name))

    @property
    def token(self) -> str:
        """The token of the node itself."""
        return self._token(TokenKind.NODE, self.id)

    def entity_token(self, kind: TokenKind, entity: int, topic: KeyedTopic, qos: Qos) -> str:
        """Return the token of a publisher or a subscription.

        Args:
            entity: its id within the session.
            qos: as requested.
        """
        return "/".join(
            [
                self._token(kind, entity),
                _mangled(topic.name),
                topic.dds_type,
                topic.type_hash,
                qos_text(qos),
            ]
        )

    def _token(self, kind: TokenKind, entity: int) -> str:
        enclave = _mangled("/")
        who = f"{enclave}/{_mangled(self.namespace)}/{self.name}"
        return f"@ros2_lv/{self.domain}/{self.session}/{self.id}/{entity}/{kind}/{who}"


def depth(qos: Qos) -> int:
    """Return how many samples a cache holds; ROS leaves that to the middleware where all are to be kept."""
    return qos.depth or DEFAULT_DEPTH


def qos_text(qos: Qos) -> str:
    """Return a quality of service in the form of tokens: numbers of rmw's enumerations, empty for a default.

    In order: reliability, durability, history and depth, deadline, lifespan, liveliness and its lease; what
    follows the depth is never set here.
    """
    reliability = "" if qos.reliable else "2"
    durability = "1" if qos.transient_local else ""
    history = "" if qos.depth else "2"
    size = "" if depth(qos) == DEFAULT_DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:{history},{size}:,:,:,,"


def _mangled(name: str) -> str:
    """Return a name as one chunk of a key."""
    return name.replace("/", "%")
