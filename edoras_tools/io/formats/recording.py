"""The contents of a recording, independent of its format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Collection

    from edoras_tools.links.protocol import Endpoints
    from edoras_tools.sessions.sequence import SequenceCounts
    from edoras_tools.structs import Structs


@dataclass(frozen=True, slots=True)
class RecordingOptions:
    """What a recording contains, and how files are split.

    Attributes:
        filter: the filter that selected the datagrams, for the metadata record.
        split_bytes: start a new file before one grows larger than about this; 0: never.
        split_ns: start a new file when one covers this much capture time; 0: never.
        split_count: start a new file after so many datagrams; 0: never.
        datagrams: whether to write ``/edoras/datagrams``.
        structs: C structs in packets; None: only cFE's own.
        transforms: whether to write ``/tf``, made of the poses.
        jobs: how many processes may share the work; more than one only for MCAP, and if not split by size.
        yields: share it only while a processor is free, so that others that record have theirs.
        sequences: shared with others that see the same batches; None: the recording follows its own.
        endpoints: of DDS, as they are learnt; None: samples of theirs have no topics.
        topics: of a recording without datagrams: places of the topics that are written; None: all.
        offered: quality of service of every topic, as the YAML of ``ros2 bag``; empty if unknown.
    """

    filter: str = ""
    split_bytes: int = 0
    split_ns: int = 0
    split_count: int = 0
    datagrams: bool = True
    structs: Structs | None = None
    offered: str = ""
    transforms: bool = False
    jobs: int = 1
    yields: bool = False
    sequences: SequenceCounts | None = None
    endpoints: Endpoints | None = None
    topics: Collection[int] | None = None

    @property
    def splits(self) -> bool:
        """Whether the recording is written in parts."""
        return bool(self.split_bytes or self.split_ns or self.split_count)
