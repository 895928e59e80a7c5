"""What makes a participant a node to ``ros2 node list``: its entities, told on ``ros_discovery_info``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from edoras_tools.middleware.graph import Qos

if TYPE_CHECKING:
    from collections.abc import Iterable

    from edoras_tools.ros import TypeStore

TOPIC: Final = "ros_discovery_info"
"""A DDS name: ROS puts no ``rt/`` before it."""
TYPE: Final = "rmw_dds_common/msg/ParticipantEntitiesInfo"
QOS: Final = Qos(transient_local=True, depth=1)
ENCLAVE: Final = b"enclave=/;"
"""User data of a participant: its place in the security hierarchy, without which it is none of ROS 2."""


def presence(
    types: TypeStore,
    node: tuple[str, str],
    participant: bytes,
    readers: Iterable[bytes],
    writers: Iterable[bytes],
) -> bytes:
    """Return the message that tells what a participant consists of.

    Args:
        types: knows ``TYPE``; the size of an identifier is its distribution's.
        node: its namespace and its name.
        participant: GUID, 16 bytes, as all that follow.
        readers: of the node's topics.
        writers: of the node's topics.
    """
    size = types.fields("rmw_dds_common/msg/Gid")[0].size

    def gid(guid: bytes) -> dict[str, Any]:
        return {"data": guid.ljust(size, b"\0")}

    entities = {
        "node_namespace": node[0],
        "node_name": node[1],
        "reader_gid_seq": [gid(item) for item in readers],
        "writer_gid_seq": [gid(item) for item in writers],
    }
    return types.encode(TYPE, {"gid": gid(participant), "node_entities_info_seq": [entities]})
