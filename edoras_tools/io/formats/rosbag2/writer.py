"""rosbag2 directories: a recording in MCAP storage, and the ``metadata.yaml`` that ``ros2 bag`` needs."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final

from msgspec.structs import replace
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io import RecordingOptions
from edoras_tools.io.formats.mcap.writer import McapSink
from edoras_tools.io.outputs import check_links, write_bytes
from edoras_tools.ros import TypeStore
from edoras_tools.ros.library import distros
from edoras_tools.ros.type_hash import type_hash

if TYPE_CHECKING:
    from edoras_tools.io.formats.mcap.file import McapFile
    from edoras_tools.mission import Mission
    from edoras_tools.model import HostCounters, SourceInfo, SourceStatistics

_VERSIONS: Final = {"iron": 8, "jazzy": 9}
"""Metadata version by the distribution that introduced it; older distributions read up to ``_OLDEST``."""
_OLDEST: Final = 5
_WITH_HASHES: Final = 7
_WITH_DISTRO: Final = 8
_WITH_NAMED_QOS: Final = 9
_FOREVER: Final = {"sec": 9223372036, "nsec": 854775807}
_QOS: Final = {
    "history": ("keep_last", 1),
    "depth": (10, 10),
    "reliability": ("reliable", 1),
    "durability": ("volatile", 2),
    "deadline": (_FOREVER, _FOREVER),
    "lifespan": (_FOREVER, _FOREVER),
    "liveliness": ("automatic", 1),
    "liveliness_lease_duration": (_FOREVER, _FOREVER),
    "avoid_ros_namespace_conventions": (False, False),
}
"""ROS's default quality of service, which the bridges use: by name from version 9 on, by number before."""

_POLICIES: Final = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": ("system_default", "automatic", "manual_by_node", "manual_by_topic", "unknown"),
}
"""Policies by their number in ``rmw/types.h``."""


class Rosbag2Sink(McapSink):
    """Writes batches to ``NAME/NAME_0.mcap`` and so on, and ``NAME/metadata.yaml`` when closed.

    Arguments are those of ``McapSink``; ``path`` is the directory: it is created, and must be empty.

    Raises:
        CaptureError: from every method: the directory or a file in it cannot be written.
    """

    def __init__(
        self,
        path: str | Path,
        mission: Mission,
        types: TypeStore,
        info: SourceInfo,
        options: RecordingOptions = RecordingOptions(),  # noqa: B008  frozen
        *,
        statistics: SourceStatistics | None = None,
    ) -> None:
        self._folder = Path(path)
        with os_errors(f"{path}: cannot be made a directory"):
            check_links(self._folder)
            self._folder.mkdir(parents=True, exist_ok=True)
            occupied = any(self._folder.iterdir())
        if occupied:
            raise CaptureError(f"{path}: is not empty; name a new directory")
        # rosbag2 numbers its files even if there is only one.
        suffix = "" if options.splits else "_0"
        file = self._folder / f"{self._folder.name}{suffix}.mcap"
        options = replace(options, offered=_text(_offered(_version(types.distro))))
        super().__init__(file, mission, types, info, options, statistics=statistics)
        self._ended = False

    @property
    def paths(self) -> list[Path]:
        """The directory written."""
        return [self._folder]

    def write_host(self, host: HostCounters) -> None:
        """Do nothing: these recordings do not hold the counters of the host."""

    def abandon(self) -> None:
        """Close the file in its present state; nothing more is written."""
        self._ended = True
        super().abandon()

    def close(self, statistics: SourceStatistics) -> None:
        """Complete the storage, and write ``metadata.yaml``."""
        if self._ended:
            return
        self._ended = True
        place = self.output.place  # another directory, if it was moved
        super().close(statistics)

        target = (place.parent if place else self._folder) / "metadata.yaml"
        text = StringIO()
        _yaml(_metadata(self.files, self._types), text)
        write_bytes(target, text.getvalue().encode())


def _yaml(content: Any, file: IO[str]) -> None:
    writer = YAML(typ="safe", pure=True)
    writer.representer.ignore_aliases = lambda _: True
    writer.dump(content, file)


def _version(distro: str) -> int:
    names = distros()
    place = names.index(distro) if distro in names else len(names)
    return max(
        (version for name, version in _VERSIONS.items() if names.index(name) <= place), default=_OLDEST
    )


def _offered(version: int) -> str | list[dict[str, Any]]:
    """Return the quality of service of every topic, in the notation of a metadata version."""
    if version >= _WITH_NAMED_QOS:
        return [{name: by_name for name, (by_name, _) in _QOS.items()}]
    return _text([{name: by_number for name, (_, by_number) in _QOS.items()}])


def _text(offered: str | list[dict[str, Any]]) -> str:
    """Return a quality of service as text, as a channel of the storage has it."""
    return offered if isinstance(offered, str) else _yaml_text(offered)


def _yaml_text(content: Any) -> str:
    text = StringIO()
    _yaml(content, text)
    return text.getvalue().rstrip()


def _recorded_qos(text: str, version: int) -> str | list[dict[str, Any]]:
    """Return the quality of service of a copied topic, in the notation of a metadata version."""
    try:
        profiles = YAML(typ="safe").load(text)
    except YAMLError:
        profiles = None
    if not isinstance(profiles, list) or not all(isinstance(item, dict) for item in profiles):
        return [] if version >= _WITH_NAMED_QOS else ""
    policies = [
        {name: _qos_value(name, value, by_name=version >= _WITH_NAMED_QOS) for name, value in item.items()}
        for item in profiles
    ]
    return policies if version >= _WITH_NAMED_QOS else _yaml_text(policies)


def _qos_value(name: str, value: Any, *, by_name: bool) -> Any:
    """Return a policy by name or by number, as rmw numbers them; any other value unchanged."""
    names = _POLICIES.get(name, ())
    if by_name and isinstance(value, int) and value < len(names):
        return names[value]
    return names.index(value) if not by_name and value in names else value


def _metadata(files: list[McapFile], types: TypeStore) -> dict[str, Any]:
    """Return the content of ``metadata.yaml`` in the version of the distribution of the types."""
    version = _version(types.distro)
    offered = _offered(version)
    summaries = [file.summary for file in files]
    filled = [summary for summary in summaries if summary.start_ns is not None]
    start = min((summary.start_ns or 0 for summary in filled), default=0)
    end = max((summary.end_ns for summary in filled), default=0)
    topics: dict[tuple[str, str, str, str], int] = {}
    for summary in summaries:
        for channel_id, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)  # a copied recording may have none
            qos = channel.metadata.get("offered_qos_profiles", "")
            key = (channel.topic, schema.name if schema else "", channel.message_encoding, qos)
            topics[key] = topics.get(key, 0) + summary.counts.get(channel_id, 0)
    schemas = {
        item.name: item.data.decode()
        for summary in summaries
        for item in summary.schemas.values()
        if item.encoding == "ros2msg"
    }
    written = TypeStore(types.distro, definitions=schemas)

    def described(topic: str, type_name: str, encoding: str, qos: str) -> dict[str, Any]:
        hashed = {}
        if version >= _WITH_HASHES and written.has(type_name):
            hashed = {"type_description_hash": type_hash(written, type_name)}
        return {
            "name": topic,
            "type": type_name,
            "serialization_format": encoding,
            "offered_qos_profiles": offered if qos == _text(offered) else _recorded_qos(qos, version),
            **hashed,
        }

    return {
        "rosbag2_bagfile_information": {
            "version": version,
            "storage_identifier": "mcap",
            "duration": {"nanoseconds": end - start},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": sum(topics.values()),
            "topics_with_message_count": [
                {"topic_metadata": described(*names), "message_count": count}
                for names, count in topics.items()
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
            **({"custom_data": None, "ros_distro": types.distro} if version >= _WITH_DISTRO else {}),
        }
    }
