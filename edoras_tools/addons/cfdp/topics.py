"""Messages from CFDP: files of ``data_transfer``, each a ROS message in an EDORAS envelope.

Rules:

1. A file belongs to the topic whose ``store_filename`` ends with the same name. It becomes a message when its
   transaction has finished, with that time, if every byte was captured and its checksum is not wrong.
2. It is a message only if it is an envelope with a complete message of the topic's type.
3. At most ``MOST_BYTES`` of unfinished files are kept; further files are left out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.addons.cfdp.link import CFDP
from edoras_tools.addons.cfdp.transactions import FileEvidence, Transaction
from edoras_tools.io.topics.rows import RECORD, Messages, whole_messages
from edoras_tools.wire.arrays.window import PADDING
from edoras_tools.wire.envelope import detect

if TYPE_CHECKING:
    from edoras_tools.links.doors import TopicSpace
    from edoras_tools.mission import Mission, StoredTopic
    from edoras_tools.model import Columns, PacketBatch

MOST_BYTES: Final = 64 << 20


class FileTopics:
    """Follows CFDP transactions, and makes messages of their files.

    Args:
        space: topic space whose mission assigns files to topics.
    """

    def __init__(self, space: TopicSpace) -> None:
        mission: Mission = space.mission
        self._space = space
        self._topics = {item.file_name: item for item in reversed(mission.stored_topics)}
        self._follower = FileEvidence(self._keep, mission.pdu_msg_ids)
        self._open: dict[Transaction, bytearray] = {}
        self._bytes = 0
        self._finished: list[tuple[Transaction, StoredTopic, bytes]] = []
        self._left_out: set[Transaction] = set()

    def _topic(self, item: Transaction) -> StoredTopic | None:
        names = (item.destination_file_name, item.source_file_name)
        topics = (self._topics.get(name.rpartition("/")[2]) for name in names if name)
        return next((topic for topic in topics if topic), None)

    def _keep(self, item: Transaction, offset: int, piece: bytes) -> None:
        if item in self._left_out:
            return
        content = self._open.setdefault(item, bytearray())
        more = max(offset + len(piece) - len(content), 0)
        if self._bytes + more > MOST_BYTES:
            self._finish()
        if self._bytes + more > MOST_BYTES:
            self._bytes -= len(self._open.pop(item))
            self._left_out.add(item)
            return
        self._bytes += more
        content.extend(bytes(more))
        content[offset : offset + len(piece)] = piece

    def _finish(self) -> None:
        """Remove finished transactions from those that are kept."""
        for item in [item for item in self._open if item.finished_ns is not None]:
            content = bytes(self._open.pop(item))
            self._bytes -= len(content)
            self._left_out.add(item)
            topic, envelope = self._topic(item), detect(content)
            if topic and envelope and item.complete and item.checksum_right is not False:
                cdr = content[envelope.size : envelope.size + envelope.parse(content)[0]]
                self._finished.append((item, topic, cdr))

    def offer(self) -> None:
        """Do nothing: a topic is added with its first file."""

    def messages(self, batch: PacketBatch, columns: Columns) -> list[Messages]:
        """Add a batch; return the messages of the files whose transactions finished in it."""
        self._follower.add(batch, columns)
        self._finish()
        finished, self._finished = self._finished, []
        by_topic: dict[StoredTopic, list[tuple[Transaction, bytes]]] = {}
        for item, topic, cdr in sorted(finished, key=lambda item: item[0].finished_ns or 0):
            by_topic.setdefault(topic, []).append((item, cdr))
        messages = (self._of_topic(batch, topic, items) for topic, items in by_topic.items())
        return [item for item in messages if item is not None]

    def _of_topic(
        self, batch: PacketBatch, topic: StoredTopic, items: list[tuple[Transaction, bytes]]
    ) -> Messages | None:
        """Return the messages in one topic's files; None if no file contains one."""
        data = np.frombuffer(b"".join(cdr for _, cdr in items) + bytes(PADDING), np.uint8)
        length = np.array([len(cdr) for _, cdr in items], np.int32)
        offset = np.cumsum(length, dtype=np.int64) - length
        trailing = self._space.types.trailing(topic.type, data, offset, length)
        whole = trailing >= 0
        if not whole.any():
            return None
        size, offset = (length - trailing)[whole], offset[whole]
        whole_items = [item for (item, _), good in zip(items, whole.tolist(), strict=True) if good]
        time_ns = np.array([item.finished_ns for item in whole_items], np.int64)
        count = np.array([item.transaction_sequence_number & 0xFFFFFFFF for item in whole_items])
        row = np.minimum(np.searchsorted(batch.time_ns, time_ns), len(batch) - 1)
        heads = np.empty(len(whole_items), np.dtype(RECORD))
        number = self._space.place(topic.topic, topic.type, {"link": CFDP.label, "file": topic.file_name})
        return whole_messages(row, heads, number, count, time_ns, time_ns, (data, offset, size), repeats=True)
