"""What the doors of a link take and give: state that goes from batch to batch, and what comes of it.

A link of headers alone has none of these. Floors above give and take what stands here as ``Any``: each says
which type it is.
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
        """What endpoints announced; None where nobody decodes it."""

    def used_names(self) -> set[str]:
        """Return the names of topics that other messages have, or may have."""

    def place(self, name: str, type_name: str, metadata: Mapping[str, str]) -> int:
        """Return the channel of a topic, which is added at first use."""


class OwnTopics(Protocol):
    """Makes messages of a link's datagrams, on topics that only the content names."""

    def messages(self, batch: PacketBatch, columns: Columns) -> Iterable[Any]:
        """Return the ``io.topics.rows.Messages`` of a batch, as copies; batches come in order."""

    def offer(self) -> None:
        """Add the topics that are known already, before a message of theirs comes."""


class OwnRows(Protocol):
    """Puts together what comes in pieces: each whole is a row of its own behind that of its last piece."""

    def take(
        self, batch: PacketBatch, columns: Columns, decode: Callable[[PacketBatch], Columns]
    ) -> tuple[PacketBatch, Columns]:
        """Return a batch and its columns with the rows that become whole in it; batches come in order.

        Args:
            decode: reads rows that were made.
        """

    def notes(self) -> list[str]:
        """Return what came, a line each, for users."""


class Unwrapper(Protocol):
    """Takes packets out of what carries them, before a batch is decoded."""

    @property
    def pieces(self) -> int:
        """Carriers that were read."""

    def take(self, batch: PacketBatch) -> PacketBatch:
        """Return a batch with the packets that end in it as rows of their own; batches come in order."""

    def notes(self) -> list[str]:
        """Return what came, a line each, for users."""


class KnownSamples(msgspec.Struct, frozen=True, eq=False):
    """Samples of one topic whose type is known, in the order of the rows; of one length.

    Attributes:
        topic: its ROS name.
        type: its ROS type.
        row: i64, of the batch.
        writers: GUIDs.
        writer: i64, which of them wrote it.
        sequence_number: i64, the writer's.
        offset: i64, of the CDR encapsulation in the batch's data.
        length: i32, bytes, padding included.
        written_ns: i64, when it was written, ns since 1970; -1 where nobody says.
        valid: bool, whether it is a whole message.
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
    """Reads samples in datagrams: messages of writers that announce their topics, and sign what they send."""

    def known_samples(
        self, types: Any, endpoints: Endpoints, batch: PacketBatch, rows: Places
    ) -> Iterator[KnownSamples]:
        """Yield the samples of each topic and type.

        Args:
            types: a ``ros.TypeStore``; None: no type is known.
            rows: those of the link.
        """

    def rows_on(
        self, batch: PacketBatch, rows: Places, endpoints: Endpoints, holds: Callable[[str], bool]
    ) -> Places:
        """Return those of some rows that have a sample of a topic that ``holds`` accepts."""

    def writers(self, batch: PacketBatch, rows: Places) -> Iterable[bytes]:
        """Return the GUIDs of the writers that some rows are about."""

    def topic_of(self, guid: bytes, endpoints: Endpoints) -> str:
        """Return what the topic of a writer is called, also where it was not announced."""


class SampleStream(msgspec.Struct, frozen=True):
    """The samples of one writer.

    Attributes:
        topic: its ROS name, or what it is called.
        count: samples that were captured, each once.
        first_ns: time of the first.
        last_ns: time of the last.
        longest_ns: the longest time between two of them.
    """

    topic: str
    count: int
    first_ns: int
    last_ns: int
    longest_ns: int


class Follower:
    """What a link counts in the batches of a stream, for ``info``; this one counts nothing."""

    def add(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch; they come in order."""

    def summary(self) -> dict[str, Any]:
        """Return what ``info --json`` says more."""
        return {}

    def counts(self) -> Sequence[Any]:
        """Return the sequence counts of packets that have no row, each a ``sessions.sequence.Stream``."""
        return ()


class LinkEvidence(Follower):
    """What a link saw in the batches of a stream, for the doctor; this one saw nothing.

    Attributes:
        datagrams: those that the doctor has no row of, and judges by this alone.
        reassembled: rows among these that were put together, and not captured.
    """

    datagrams: int = 0
    reassembled: int = 0

    def samples(self) -> Sequence[SampleStream]:
        """Return the samples of each writer."""
        return ()

    def spans(self) -> list[tuple[int, int]]:
        """Return from when to when something was captured, ns since 1970."""
        return []

    def rows(self, drops: int | None) -> list[Any]:
        """Return witness rows, each a ``diagnosis.ledger.Row``.

        Args:
            drops: frames that the capture itself lost; None where it does not tell.
        """
        return []

    def missing(self, drops: int | None) -> list[Any]:
        """Return what was lost, each a ``diagnosis.missing.Missing``; see ``rows``."""
        return []
