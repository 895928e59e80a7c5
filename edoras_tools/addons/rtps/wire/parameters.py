"""Parameter lists: announcements of participants about themselves and their endpoints (9.6.3).

Reading is lenient: a list that is cut, or has no end, is read as far as possible.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final, Literal

import msgspec

from edoras_tools.addons.rtps.wire.headers import GUID_BYTES
from edoras_tools.middleware.graph import ros_name

if TYPE_CHECKING:
    from collections.abc import Iterator

MOST_PARAMETERS_READ: Final = 1 << 9
LONGEST_TEXT: Final = 1 << 10
"""Longest name, bytes; longer ones are cut."""
_MUST_UNDERSTAND: Final = 0x3FFF
"""Bits of a parameter id without the flags for vendors and for parameters that must be understood."""
_ENCAPSULATIONS: Final[dict[int, Literal["big", "little"]]] = {0x0002: "big", 0x0003: "little"}
"""Byte order by the representation of PL_CDR."""


class ParameterId(IntEnum):
    """The parameters that are read (table 9.18)."""

    PAD = 0x0000
    SENTINEL = 0x0001
    TOPIC_NAME = 0x0005
    TYPE_NAME = 0x0007
    RELIABILITY = 0x001A
    DURABILITY = 0x001D
    UNICAST_LOCATOR = 0x002F
    DEFAULT_UNICAST_LOCATOR = 0x0031
    HISTORY = 0x0040
    PARTICIPANT_GUID = 0x0050
    ENDPOINT_GUID = 0x005A
    ENTITY_NAME = 0x0062
    STATUS_INFO = 0x0071


_LOCATORS: Final = (ParameterId.UNICAST_LOCATOR, ParameterId.DEFAULT_UNICAST_LOCATOR)
_SHARED_MEMORY: Final = 16
"""Kind of a Fast DDS locator that is no network address (its ``LOCATOR_KIND_SHM``)."""
_RELIABLE: Final = 2
"""Reliable kind of reliability (9.3.2)."""
STATUS_NAMES: Final = {1: "disposed", 2: "unregistered"}


class Announcement(msgspec.Struct, frozen=True):
    """The announcement of a participant or an endpoint; absent values are empty or None.

    Attributes:
        guid: GUID of the endpoint, or of the participant.
        topic: name in DDS: ``rt/cmd_vel``.
        type: name in DDS: ``geometry_msgs::msg::dds_::Twist_``.
        name: name of the participant.
        shared_memory: whether it can be reached through its host's memory, without a network.
        reliable: whether a writer sends lost samples again; DDS's default for writers.
        transient_local: whether late subscribers get the last samples.
        depth: number of samples that it keeps; 0 if it is not given, or all are kept.
    """

    guid: bytes
    topic: str = ""
    type: str = ""
    name: str = ""
    shared_memory: bool = False
    reliable: bool = True
    transient_local: bool = False
    depth: int = 0

    @property
    def is_writer(self) -> bool:
        """Whether it is about a writer (table 9.1)."""
        return self.guid[-1:] in {b"\x02", b"\x03"}

    @property
    def ros_topic(self) -> str:
        """Name of the topic in ROS."""
        return ros_topic(self.topic)

    @property
    def ros_type(self) -> str:
        """Name of the type in ROS."""
        return ros_name(self.type)


def read_parameters(data: bytes) -> Iterator[tuple[int, bytes, Literal["big", "little"]]]:
    """Yield id, value and byte order of each parameter in an encapsulation; nothing if it is no list.

    Args:
        data: bytes from the encapsulation on.
    """
    order = _ENCAPSULATIONS.get(int.from_bytes(data[:2], "big"))
    if order is not None:
        yield from read_parameter_list(data[4:], order)


def read_parameter_list(
    data: bytes, order: Literal["big", "little"]
) -> Iterator[tuple[int, bytes, Literal["big", "little"]]]:
    """Yield id, value and byte order of each parameter in a list without encapsulation, such as inline QoS.

    Args:
        data: bytes from the first parameter on; bytes behind the last one are ignored.
        order: byte order.
    """
    at = 0
    for _ in range(MOST_PARAMETERS_READ):
        if at + 4 > len(data):
            return
        number = int.from_bytes(data[at : at + 2], order)
        size = int.from_bytes(data[at + 2 : at + 4], order)
        if number == ParameterId.SENTINEL or at + 4 + size > len(data):
            return
        yield number, data[at + 4 : at + 4 + size], order
        at += 4 + size


def read_status(data: bytes, order: Literal["big", "little"]) -> str:
    """Return the status of an instance in inline QoS; empty if there is none (9.6.4.9)."""
    for number, value, _ in read_parameter_list(data, order):
        if number & _MUST_UNDERSTAND == ParameterId.STATUS_INFO and len(value) >= 4:
            return " and ".join(name for bit, name in STATUS_NAMES.items() if value[3] & bit)
    return ""


def read_announcement(data: bytes) -> Announcement | None:
    """Read the announcement of a participant or an endpoint; None if it has no GUID.

    Args:
        data: bytes from the encapsulation on.
    """
    guids = dict.fromkeys((ParameterId.ENDPOINT_GUID, ParameterId.PARTICIPANT_GUID), b"")
    texts = dict.fromkeys((ParameterId.TOPIC_NAME, ParameterId.TYPE_NAME, ParameterId.ENTITY_NAME), "")
    numbers = {ParameterId.RELIABILITY: _RELIABLE, ParameterId.DURABILITY: 0, ParameterId.HISTORY: 0}
    shared_memory = False
    for number, value, order in read_parameters(data):
        parameter: Any = number & _MUST_UNDERSTAND
        if parameter in guids and len(value) >= GUID_BYTES:
            guids[parameter] = value[:GUID_BYTES]
        elif parameter in texts:
            texts[parameter] = _text(value, order)
        elif parameter in numbers:
            # The depth follows the kind keep_last, 0; behind keep_all it has no meaning.
            at = 4 + 4 * any(value[:4]) if parameter == ParameterId.HISTORY else 0
            numbers[parameter] = int.from_bytes(value[at : at + 4], order)
        elif parameter in _LOCATORS:
            shared_memory |= int.from_bytes(value[:4], order) == _SHARED_MEMORY
    guid, participant = guids.values()
    reliability, durability, depth = numbers.values()
    topic, kind, name = texts.values()
    owner, qos = guid or participant, (reliability >= _RELIABLE, durability > 0, depth)
    return Announcement(owner, topic, kind, name, shared_memory, *qos) if owner else None


def _text(value: bytes, order: Literal["big", "little"]) -> str:
    size = min(int.from_bytes(value[:4], order), LONGEST_TEXT)
    text = value[4 : 4 + size].split(b"\0", 1)[0].decode("utf-8", "replace")
    return text if text.isprintable() else "".join(item if item.isprintable() else "?" for item in text)


_TOPIC: Final = "rt/"
"""Prefix of ROS topics in DDS; topics of requests and replies keep theirs."""


def ros_topic(topic: str) -> str:
    """Return the ROS name of a DDS topic; the DDS name if it is no ROS topic.

    https://design.ros2.org/articles/topic_and_service_names.html
    """
    return topic.removeprefix(_TOPIC[:-1]) if topic.startswith(_TOPIC) else topic
