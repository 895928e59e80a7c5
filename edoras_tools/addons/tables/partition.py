"""``edoras export --partition``: a folder for each topic, in it one for each recording, in Hive's form."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from edoras_tools.addons.tables.recordings import recordings_in
from edoras_tools.errors import CaptureError, ConfigError, InterruptError, RouteError, os_errors
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.export.sources import open_topics, recording_names
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.export.tables import TableForm
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.render.terminal.text import Progress


@dataclass(frozen=True, slots=True)
class _Partition(ExportTarget):
    """The output of one recording.

    Attributes:
        recording: its name.
    """

    recording: str = ""

    def place(self, topic: str) -> Path:
        """Return the file of a topic, ``TOPIC/recording=NAME/data.parquet``; its folder is made."""
        folder = ExportTarget.place(self, topic).with_suffix("")
        folder /= f"recording={quote(self.recording, safe=' ')}"
        with os_errors(f"{folder}: cannot be created"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder / f"data{self.format.suffix}"


def export_partitioned(
    files: Sequence[Path],
    target: ExportTarget,
    settings: Settings,
    scope: Scope,
    patterns: Sequence[str],
    form: TableForm,
    progress: Progress | None,
    jobs: int,
) -> tuple[dict[str, Any], CaptureError | None]:
    """Export recordings, each by itself and with its own mission.

    Args:
        files: recordings, or folders of them.
        target: a folder; the rest as of ``export``.

    Returns:
        What was written, in the form of ``export --json``, and an error if recordings could not be read
        whole: they are named in ``warnings``, as are those without a message on the topics.

    Raises:
        CaptureError: a table cannot be written, or there is nothing to write.
        ConfigError: the output is no folder or not empty, or a mission or a field has a mistake.
    """
    if not target.folder:
        raise ConfigError(f"{target.path}: --partition writes folders: name one that ends with /")
    paths = recordings_in(files)
    written: list[dict[str, Any]] = []
    warnings: Counter[str] = Counter()
    left_out = failed = 0
    for place, (path, name) in enumerate(zip(paths, recording_names([*map(str, paths)]), strict=True)):
        if progress is not None:
            progress.step("exporting", place, len(paths))
        own = _Partition(target.path, target.format, target.folder, target.force, name)
        try:
            report = export(open_topics([path], settings, scope), own, patterns, form, None, jobs)
        except RouteError as error:
            warnings[str(error)] += 1
            continue
        except CaptureError as error:
            warnings[str(error)] += 1
            failed += 1
            continue
        written += [{**item, "recording": name} for item in report.summary()["files"]]
        left_out += report.source.left_out
        warnings.update(report.source.notes)
        if (failure := report.source.failure) is not None:
            if isinstance(failure, InterruptError):
                raise failure
            warnings[str(failure)] += 1
            failed += 1
    if not written:
        raise CaptureError(next(iter(warnings)))
    lines = [f"{line} ({count:,} recordings)" if count > 1 else line for line, count in warnings.items()]
    summary = {"source": listed([*map(str, files)], 3), "files": written, "left_out": left_out}
    whole = CaptureError(f"{failed:,} of {plural(len(paths), 'recording')} could not be read whole")
    return {**summary, "warnings": lines}, whole if failed else None


def by_topic(summary: dict[str, Any]) -> dict[str, Any]:
    """Return what was written with one entry a topic, its folder and the rows of all recordings."""
    topics: dict[str, dict[str, Any]] = {}
    for item in summary["files"]:
        first = topics.setdefault(
            item["topic"], {**item, "path": f"{Path(item['path']).parents[1]}/", "rows": 0}
        )
        first["rows"] += item["rows"]
    return {**summary, "files": [*topics.values()]}
