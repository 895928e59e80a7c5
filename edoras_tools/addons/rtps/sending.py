"""Sends samples again: each recorded writer is replaced by one of ours, with its quality of service.

The samples go out through the middleware of the bridges, which gives them new numbers and finds the
subscribers. Each sample to send is an RTPS message with one DATA of its recorded writer; only this file
reads it.
"""

from __future__ import annotations

import socket
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from edoras_tools import doors
from edoras_tools.addons.rtps.reader import rtps_messages, topic_samples
from edoras_tools.addons.rtps.samples import sample_message
from edoras_tools.addons.rtps.wire import Announcement, read_messages
from edoras_tools.errors import ConfigError, OnFailure, WireError
from edoras_tools.io.net.sockets import SendResult
from edoras_tools.io.net.transmit import SendStatistics
from edoras_tools.links.protocol import LinkSending, SendingSession
from edoras_tools.middleware import MOST_DOMAIN, Qos
from edoras_tools.middleware.graph import usual_domain
from edoras_tools.model import Columns, Endpoint, Link, PacketBatch
from edoras_tools.sessions.ranges import KnownRanges
from edoras_tools.units import SECOND
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from edoras_tools.links.doors import Site
    from edoras_tools.wire.arrays import Integers, Mask, Octets

_FIRST_PORT: Final = 7400
_PORTS_OF_DOMAIN: Final = 250
"""Ports per domain (RTPS 9.6.1.1)."""
_KEPT: Final = 10
"""Samples that a writer keeps for late subscribers if it did not announce a depth: ROS's default."""
_OTHERS_NS: Final = SECOND
"""Time to wait for further subscribers after the first one."""
_ACKNOWLEDGED_WITHIN_NS: Final = 5 * SECOND
_ALONE: Final = {"interface": "lo", "multicast": "false", "peers": "127.0.0.1"}
_NODE: Final = "edoras_replay"


class Subscribers(SendingSession):
    """Waits until the topics have subscribers, and at the end until these have acknowledged all samples."""

    _writers: WritersTransmitter

    def __init__(self) -> None:
        self._first_ns = self._sent_ns = self._now = 0
        self._notes: list[str] = []

    @property
    def next_ns(self) -> int:  # type: ignore[override]
        """Always the present: the session is called at every turn."""
        return 0

    def begin(self, writers: WritersTransmitter) -> None:
        """Store the writers that send the samples."""
        self._writers = writers

    def due(self, *, now: int) -> Iterable[bytes]:
        """Store the time; nothing is sent."""
        self._now = now
        return ()

    def sent(self, *, now: int) -> None:
        """Record that samples were sent, so that acknowledgements are awaited."""
        self._sent_ns = now

    @property
    def connected(self) -> bool:  # type: ignore[override]
        """Whether all topics have a subscriber, or one has and the others had time to find theirs."""
        alone = self._writers.topics_alone()
        if len(alone) < len(self._writers.topics):
            self._first_ns = self._first_ns or self._now
            return not alone or self._now - self._first_ns >= _OTHERS_NS
        return False

    @property
    def busy(self) -> bool:  # type: ignore[override]
        """Whether a reliable subscriber has not acknowledged everything, for a limited time."""
        late = self._now - self._sent_ns > _ACKNOWLEDGED_WITHIN_NS
        return not late and not self._writers.graph.acknowledged()

    def absence(self) -> str:
        """Return the topics without a subscriber, with the middleware's notes."""
        notes = "".join(f"; {note}" for note in self._writers.graph.notes())
        return f"no subscriber of {listed(self._writers.topics)} in {self._writers.place}{notes}"

    def goodbye(self) -> Iterable[bytes]:
        """Note the fate of the samples; nothing is sent."""
        if alone := self._writers.topics_alone():
            self._notes.append(f"no subscriber of {listed(alone)}: its samples reached nobody")
        if not self._writers.graph.acknowledged():
            self._notes.append("some subscribers did not acknowledge all samples")
        self._notes += self._writers.graph.notes()
        return ()

    def notes(self) -> Iterable[str]:
        """Return the notes."""
        return self._notes


class WritersTransmitter(AbstractContextManager["WritersTransmitter"]):
    """Writers in a domain, with the interface of a ``Transmitter``. It is a context manager.

    Args:
        types: types of all topics.
        announced: announcements of the recorded writers.
        target: address whose port selects the domain. A loopback address reaches this machine, a multicast
            address all participants that discovery finds, any other address that machine.

    Attributes:
        topics: topics that are written.
        graph: node.
        place: text on the domain, for users.
        target: target.
        local: address that would receive answers.
        statistics: counters of samples.

    Raises:
        ConfigError: the port belongs to no domain, or the middleware is absent or refuses.
    """

    def __init__(self, types: Any, announced: Sequence[Announcement], target: Endpoint) -> None:
        domain, rest = divmod(target.port - _FIRST_PORT, _PORTS_OF_DOMAIN)
        if rest or not 0 <= domain <= MOST_DOMAIN:
            raise ConfigError(
                f"--target {target}: its port says the domain: {_FIRST_PORT} + {_PORTS_OF_DOMAIN} x "
                f"ROS_DOMAIN_ID, {_FIRST_PORT} for 0"
            )
        self.statistics, self.target = SendStatistics(), target
        self.local = Endpoint(target.address, 0)
        self.place = f"domain {domain}"
        self.topics = sorted({item.ros_topic for item in announced})
        self._woken, self._waking = socket.socketpair()
        self._woken.setblocking(False)
        address = ip_address(target.address)
        options = {} if address.is_multicast else {"peers": target.address}
        try:
            opened = doors.part("dds_graph")
        except ImportError as error:
            why = str(error).partition("\n")[0]
            raise ConfigError(f"--to rtps needs an extra ({why}): pip install 'edoras-tools[dds]'") from error
        self.graph = opened(types, _NODE, domain=domain, options=_ALONE if address.is_loopback else options)
        self._publish: dict[bytes, Callable[[bytes], None]] = {}
        with OnFailure(self.graph.close):
            for item in announced:
                # A depth does not matter for matching: a writer that keeps nothing for late subscribers has
                # none, so that it loses no sample.
                depth = (item.depth or _KEPT) if item.transient_local else 0
                qos = Qos(item.reliable, item.transient_local, depth)
                self._publish[item.guid] = self.graph.advertise(item.ros_topic, item.ros_type, qos)

    def __exit__(self, *_: object) -> None:
        self.graph.close()
        self._woken.close()
        self._waking.close()

    def fileno(self) -> int:
        """Return a descriptor that is never readable: there are no answers."""
        return self._woken.fileno()

    def topics_alone(self) -> list[str]:
        """Return the topics without a subscriber."""
        return [topic for topic in self.topics if not self.graph.subscribers(topic)]

    def send(self, payload: bytes | memoryview) -> bool:
        """Publish one sample; return whether it was written."""
        data = np.frombuffer(payload, np.uint8)
        parts = read_messages(data, np.array([0]), np.array([len(data)])).submessages
        writers, samples = topic_samples(data, parts)
        result = SendResult(1)
        try:
            self._publish[writers[0]](data[int(samples.start[0]) : int(samples.end[0])].tobytes())
        except (IndexError, KeyError):
            result = SendResult(1, errors={"damaged by a fault: no sample of a writer": 1})
        except WireError as error:
            result = SendResult(1, errors={str(error): 1})
        self.statistics.add(result)
        return not result.errors

    def send_many(self, data: Octets, offset: Integers, length: NDArray[np.int32]) -> int:
        """Publish samples in order; return how many were written. See ``Transmitter``."""
        ends = (offset + length).tolist()
        return sum(self.send(data.data[a:b]) for a, b in zip(offset.tolist(), ends, strict=True))

    def rehearse(self, payload: bytes | memoryview) -> None:
        """Do nothing: the middleware writes the samples."""

    def receive(self, most: int = 256) -> list[tuple[bytes, Endpoint]]:
        """Return nothing: subscribers answer the middleware."""
        return []


class SampleSending(LinkSending):
    """Samples of writers that announced a ROS topic of a known type, each once.

    Args:
        link: link.
        site: site that learns the writers while the recording is read.
    """

    renews = True
    instead = "edoras replay --to rtps sends recorded samples; a new one is sent by ros2 topic pub"
    own_transport = True

    def __init__(self, link: Link, site: Site) -> None:
        super().__init__(link)
        self.port = _FIRST_PORT + _PORTS_OF_DOMAIN * usual_domain()
        self.session: Subscribers = Subscribers()
        self._site = site
        self._announced: dict[bytes, Announcement] = {}

    def outgoing_rows(self, batch: PacketBatch, columns: Columns) -> Mask:
        """Return which rows have a complete sample of a user writer: bool (n,)."""
        rows = np.flatnonzero(super().outgoing_rows(batch, columns))
        _, samples = topic_samples(batch.data, rtps_messages(batch, rows).submessages)
        going = np.zeros(len(batch), bool)
        going[rows[samples.row]] = True
        return going

    def transmitter(self, target: Endpoint) -> WritersTransmitter:
        """Return the writers."""
        writers = WritersTransmitter(self._site.types, [*self._announced.values()], target)
        self.session.begin(writers)
        return writers

    def renew(self, messages: Sequence[bytes], time_ns: Integers) -> tuple[list[bytes], Integers]:
        """Return a message for each sample."""
        length = np.array([len(item) for item in messages], np.int64)
        data = np.frombuffer(b"".join(messages), np.uint8)
        parts = read_messages(data, np.cumsum(length) - length, length).submessages
        writers, samples = topic_samples(data, parts)
        refused, sendable = Counter[str](), [self._refusal(guid) for guid in writers]
        left_over = np.full(len(samples.row), -1, np.int32)
        for index, guid in enumerate(writers):
            rows = np.flatnonzero(samples.writer == index)
            if not sendable[index]:
                size = (samples.end - samples.start)[rows].astype(np.int32)
                type_name = self._announced[guid].ros_type
                left_over[rows] = self._site.types.trailing(type_name, data, samples.start[rows], size)
        before: dict[int, KnownRanges] = {}
        renewed, times = [], []
        for row, writer, number, start, end, rest, at in zip(
            *(item.tolist() for item in samples[:5]),
            left_over.tolist(),
            samples.time_ns.tolist(),
            strict=True,
        ):
            once = before.setdefault(writer, KnownRanges())
            if not once.missing(number, number + 1):
                continue
            once.add(number, number + 1)
            if why := sendable[writer] or ("are no whole message of their type" if rest < 0 else ""):
                refused[why] += 1
                continue
            body = data[start : end - rest].tobytes()
            renewed.append(sample_message((writers[writer], number), body, at, key_only=False))
            times.append(int(time_ns[row]))
        self.refusals = [f"{plural(count, 'sample')} {why}" for why, count in refused.items()]
        if not renewed:
            raise ConfigError(f"no sample can be sent: {listed(self.refusals)}")
        return renewed, np.array(times, np.int64)

    def _refusal(self, guid: bytes) -> str:
        """Return the reason why samples of a writer are not sent; empty if they are."""
        item: Any = self._site.endpoints.find(guid)
        if item is None or not item.topic:
            return "of a writer that the recording does not announce"
        if not item.ros_topic.startswith("/"):
            return f"of {item.topic}, which is no topic of ROS: its own node announces or calls with it"
        if not self._site.types.has(item.ros_type):
            return f"of the unknown type {item.ros_type}: --set msg-path adds types"
        kinds = {one.ros_type for one in self._announced.values() if one.ros_topic == item.ros_topic}
        if kinds - {item.ros_type}:
            return f"of {item.ros_topic} of the type {item.ros_type}: another is sent on it"
        self._announced[guid] = item
        return ""
