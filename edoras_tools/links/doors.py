"""The interfaces between a link and the rest: objects with state from batch to batch, and their results.

A link that has only headers needs none of these. Types of higher layers are ``Any`` here; each docstring
names the type.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import msgspec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from edoras_tools.links.site import Endpoints
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.wire.arrays.order import Integers, Mask, Places


class TopicSpace(Protocol):
    """The topics of a recording, to which a link adds its own."""

    @property
    def types(self) -> Any:
        """The ROS types, a ``ros.TypeStore``."""

    @property
    def mission(self) -> Any:
        """The ``mission.Mission``."""

    @property
    def endpoints(self) -> Endpoints | None:
        """The endpoints that announced themselves; None if nobody decodes announcements."""

    def used_names(self) -> set[str]:
        """Return the topic names that other messages have, or may get."""

    def place(self, name: str, type_name: str, metadata: Mapping[str, str]) -> int:
        """Return the channel of a topic, which is added at first use."""


class OwnTopics(Protocol):
    """Makes messages of a link's datagrams, on topics that are known only from their content."""

    def messages(self, batch: PacketBatch, columns: Columns) -> Iterable[Any]:
        """Return the ``io.topics.rows.Messages`` of a batch, as copies; batches come in order."""

    def offer(self) -> None:
        """Add the topics that are already known, before their first messages."""


class OwnRows(Protocol):
    """Reassembles pieces: each complete unit becomes a row after the row of its last piece."""

    def take(
        self, batch: PacketBatch, columns: Columns, decode: Callable[[PacketBatch], Columns]
    ) -> tuple[PacketBatch, Columns]:
        """Return a batch and its columns with the rows that become complete in it; batches come in order.

        Args:
            decode: decodes the new rows.
        """

    def notes(self) -> list[str]:
        """Return notes for users on the pieces, a line each."""


class Unwrapper(Protocol):
    """Extracts packets from their carriers (frames, for example), before a batch is decoded."""

    @property
    def pieces(self) -> int:
        """The number of carriers read."""

    def take(self, batch: PacketBatch) -> PacketBatch:
        """Return a batch with the packets that end in it as rows of their own; batches come in order."""

    def notes(self) -> list[str]:
        """Return notes for users on the carriers, a line each."""


class KnownSamples(msgspec.Struct, frozen=True, eq=False):
    """Samples of one topic with a known type, in the order of the rows; arrays have one length.

    Attributes:
        topic: ROS name of the topic.
        type: ROS type of the topic.
        row: row of the batch, i64.
        writers: GUIDs of the writers.
        writer: index of its writer in ``writers``, i64.
        sequence_number: number of the sample from its writer, i64.
        offset: start of the CDR encapsulation in the batch's data, i64.
        length: bytes, padding included, i32.
        written_ns: time of writing, i64, ns since 1970; -1 if unknown.
        valid: whether it is a whole message, bool.
    """

    topic: str
    type: str
    row: Places
    writers: list[bytes]
    writer: Integers
    sequence_number: Integers
    offset: Integers
    length: NDArray[np.int32]
    written_ns: Integers
    valid: Mask


class SampleReader(Protocol):
    """Reads samples in datagrams: messages of writers that announce their topics and identify themselves."""

    def known_samples(
        self, types: Any, endpoints: Endpoints, batch: PacketBatch, rows: Places
    ) -> Iterator[KnownSamples]:
        """Yield the samples of each topic and type.

        Args:
            types: a ``ros.TypeStore``; None: no type is known.
            rows: rows of the link.
        """

    def rows_on(
        self, batch: PacketBatch, rows: Places, endpoints: Endpoints, holds: Callable[[str], bool]
    ) -> Places:
        """Return those of some rows that have a sample of a topic that ``holds`` accepts."""

    def writers(self, batch: PacketBatch, rows: Places) -> Iterable[bytes]:
        """Return the GUIDs of the writers to which some rows belong."""

    def topic_of(self, guid: bytes, endpoints: Endpoints) -> str:
        """Return the name of a writer's topic; also one for a topic that was not announced."""


class SampleStream(msgspec.Struct, frozen=True):
    """The samples of one writer.

    Attributes:
        topic: ROS name, or a substitute.
        count: number of captured samples, each counted once.
        first_ns: time of the first.
        last_ns: time of the last.
        longest_ns: longest time between two consecutive ones.
    """

    topic: str
    count: int
    first_ns: int
    last_ns: int
    longest_ns: int


class Follower:
    """The counts of a link in the batches of a stream, for ``info``; this one counts nothing."""

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Add a batch; batches come in order."""

    def summary(self) -> dict[str, Any]:
        """Return the link's additions to ``info --json``."""
        return {}

    def counts(self) -> Sequence[Any]:
        """Return sequence counts of packets without a row, each a ``sessions.sequence.SequenceStream``."""
        return ()


class LinkEvidence(Follower):
    """The observations of a link in the batches of a stream, for the doctor; this one observes nothing.

    Attributes:
        datagrams: number of datagrams that the doctor has no rows of, and judges by these observations alone.
        reassembled: number of rows that were reassembled, not captured.
    """

    datagrams: int = 0
    reassembled: int = 0

    def samples(self) -> Sequence[SampleStream]:
        """Return the samples of each writer."""
        return ()

    def spans(self) -> list[tuple[int, int]]:
        """Return begin and end of each time in which something was captured, ns since 1970."""
        return []

    def rows(self, drops: int | None) -> list[Any]:
        """Return witness rows, each a ``diagnosis.ledger.Row``.

        Args:
            drops: number of frames that the capture itself lost; None if unknown.
        """
        return []

    def missing(self, drops: int | None) -> list[Any]:
        """Return the losses, each a ``diagnosis.missing.Missing``; see ``rows``."""
        return []
