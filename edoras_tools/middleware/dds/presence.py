"""Makes a participant visible to ``ros2 node list``: its entities, published on ``ros_discovery_info``."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Final

from edoras_tools.middleware.graph import Qos
from edoras_tools.ros import TypeStore
from edoras_tools.ros.type_hash import type_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

PRESENCE_TOPIC: Final = "ros_discovery_info"
"""A DDS name: ROS puts no ``rt/`` before it."""
PRESENCE_TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
_GID: Final = "rmw_dds_common/msg/Gid"
_NEWER: Final = 16
OLDER: Final = 24
OLDEST_DISTRO: Final = "humble"
"""The newest distribution whose nodes send no type hashes."""
_OF_SIZE: Final = {_NEWER: "iron", OLDER: OLDEST_DISTRO}
"""By the bytes of an identifier, the distribution that it began or ended with."""
QOS: Final = Qos(transient_local=True, depth=1)
ENCLAVE: Final = b"enclave=/;"
"""User data of a participant: its security enclave, without which ROS 2 ignores it."""


def presence_types(gid_bytes: int) -> TypeStore:
    """Return the types of this message where an identifier has 16 or 24 bytes."""
    return TypeStore(_OF_SIZE[gid_bytes])


def gid_bytes_of(types: TypeStore) -> int:
    """Return the bytes of an identifier in a distribution, 16 where it does not have the message."""
    return types.fields(_GID)[0].size if types.has(_GID) else _NEWER


def gid_bytes_told(hash_told: str) -> int:
    """Return the bytes of an identifier where the type has this hash; older ones have none."""
    return OLDER if hash_told in {"", _older_hash()} else _NEWER


@cache
def _older_hash() -> str:
    return type_hash(presence_types(OLDER), PRESENCE_TYPE)


def presence(
    types: TypeStore,
    node: tuple[str, str],
    participant: bytes,
    readers: Iterable[bytes],
    writers: Iterable[bytes],
) -> bytes:
    """Return the message that lists the entities of a participant.

    Args:
        types: has ``PRESENCE_TYPE``; the size of an identifier depends on the distribution.
        node: its namespace and its name.
        participant: GUID, 16 bytes, as all that follow.
        readers: of the node's topics.
        writers: of the node's topics.
    """
    size = gid_bytes_of(types)

    def gid(guid: bytes) -> dict[str, Any]:
        return {"data": guid.ljust(size, b"\0")}

    entities = {
        "node_namespace": node[0],
        "node_name": node[1],
        "reader_gid_seq": [gid(item) for item in readers],
        "writer_gid_seq": [gid(item) for item in writers],
    }
    return types.encode(PRESENCE_TYPE, {"gid": gid(participant), "node_entities_info_seq": [entities]})
