"""rosbag2 directories: a recording in MCAP storage, and the ``metadata.yaml`` that ``ros2 bag`` wants."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from edoras_tools.errors import CaptureError
from edoras_tools.sinks.mcap import McapSink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.mission import Mission
    from edoras_tools.model import Columns, PacketBatch, SourceInfo, SourceStatistics
    from edoras_tools.ros import TypeStore
    from edoras_tools.sessions.faults import Fault
    from edoras_tools.sinks.mcap_file import McapFile
    from edoras_tools.structs import Structs

_VERSION = 5
"""Of the metadata format: what ROS 2 humble writes, and every later one reads."""


class Rosbag2Sink:
    """Writes batches to ``NAME/NAME_0.mcap`` and so on, and ``NAME/metadata.yaml`` on closing.

    Args:
        path: the directory; it is made, and must not hold anything.
        mission: as for ``McapSink``.
        types: as for ``McapSink``.
        info: as for ``McapSink``.
        filter: as for ``McapSink``.
        split_bytes: as for ``McapSink``.
        split_ns: as for ``McapSink``.
        statistics: as for ``McapSink``.
        structs: as for ``McapSink``.

    Raises:
        CaptureError: from every method: the directory or a file in it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        *,
        filter: str = "",  # noqa: A002  what the option is called everywhere
        split_bytes: int = 0,
        split_ns: int = 0,
        statistics: SourceStatistics | None = None,
        structs: Structs | None = None,
    ) -> None:
        self._path = Path(path)
        try:
            self._path.mkdir(parents=True, exist_ok=True)
            occupied = any(self._path.iterdir())
        except OSError as error:
            raise CaptureError(f"{path}: cannot be made a directory: {error.strerror or error}") from error
        if occupied:
            raise CaptureError(f"{path}: is not empty; name a new directory")
        # Split or not, rosbag2 numbers its files.
        suffix = "" if split_bytes or split_ns else "_0"
        self._sink = McapSink(
            self._path / f"{self._path.name}{suffix}.mcap",
            mission,
            types,
            info,
            filter=filter,
            split_bytes=split_bytes,
            split_ns=split_ns,
            statistics=statistics,
            structs=structs,
        )
        self._closed = False

    def write(self, batch: PacketBatch, columns: Columns) -> None:
        """Take a batch and what was read from it."""
        self._sink.write(batch, columns)

    def write_faults(self, faults: Sequence[Fault]) -> None:
        """Take what was done on purpose; see ``McapSink``."""
        self._sink.write_faults(faults)

    def flush(self) -> None:
        """Get everything taken so far to the file."""
        self._sink.flush()

    def close(self, statistics: SourceStatistics) -> None:
        """Make the storage whole, and write ``metadata.yaml``."""
        self._sink.close(statistics)
        if self._closed:
            return
        self._closed = True
        from ruamel.yaml import YAML

        target = self._path / "metadata.yaml"
        try:
            with target.open("w", encoding="utf-8") as file:
                YAML(typ="safe", pure=True).dump(_metadata(self._sink.files), file)
        except OSError as error:
            raise CaptureError(f"{target}: cannot be written: {error.strerror or error}") from error


def _metadata(files: list[McapFile]) -> dict[str, Any]:
    """Return the content of ``metadata.yaml``."""
    summaries = [file.summary for file in files]
    filled = [summary for summary in summaries if summary.start_ns is not None]
    start = min((summary.start_ns or 0 for summary in filled), default=0)
    end = max((summary.end_ns for summary in filled), default=0)
    topics: dict[tuple[str, str], int] = {}
    for summary in summaries:
        for channel_id, channel in summary.channels.items():
            key = (channel.topic, summary.schemas[channel.schema_id].name)
            topics[key] = topics.get(key, 0) + summary.counts.get(channel_id, 0)
    return {
        "rosbag2_bagfile_information": {
            "version": _VERSION,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(topics.values()),
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic,
                        "type": type_name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": "",
                    },
                    "message_count": count,
                }
                for (topic, type_name), count in topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.path.name for file in files],
            "files": [
                {
                    "path": file.path.name,
                    "starting_time": {"nanoseconds_since_epoch": file.summary.start_ns or 0},
                    "duration": {"nanoseconds": file.summary.end_ns - (file.summary.start_ns or 0)},
                    "message_count": sum(file.summary.counts.values()),
                }
                for file in files
            ],
        }
    }
