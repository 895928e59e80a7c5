"""``edoras export --partition``: a folder for each topic, in it one for each recording, in Hive's form."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from edoras_tools.addons.tables.recordings import recordings_in
from edoras_tools.cli.export import print_written
from edoras_tools.cli.output import file_progress, tell
from edoras_tools.errors import CaptureError, ConfigError, EdorasError, InterruptError, RouteError, os_errors
from edoras_tools.pipelines.export.run import ExportTarget, export
from edoras_tools.pipelines.export.sources import open_topics, recording_names
from edoras_tools.words import listed, plural

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.cli.options import PrintOptions
    from edoras_tools.pipelines.doctor.scope import Scope
    from edoras_tools.pipelines.workbench import Settings


class _Partition(ExportTarget, frozen=True):
    """The output of one recording.

    Attributes:
        recording: name of the recording.
    """

    recording: str = ""

    def place(self, topic: str) -> Path:
        """Return the file of a topic, ``TOPIC/recording=NAME/data.parquet``; create its folder."""
        folder = ExportTarget.place(self, topic).with_suffix("")
        folder /= f"recording={quote(self.recording, safe=' ')}"
        with os_errors(f"{folder}: cannot be created"):
            folder.mkdir(parents=True, exist_ok=True)
        return folder / f"data{self.format.suffix}"


def export_by_recording(
    files: Sequence[Path],
    target: ExportTarget,
    settings: Settings,
    scope: Scope,
    printing: PrintOptions,
    **how: Any,
) -> None:
    """Export recordings, each separately and with its own mission, and print the result.

    Args:
        files: recordings, or folders of them.
        target: a folder.
        how: further arguments of ``export``.

    Raises:
        CaptureError: a table cannot be written, there is nothing to write, or, once all others are written,
            some recordings could not be read whole.
        ConfigError: the output is no folder or not empty, or a mission or a field has a mistake.
    """
    if not target.folder:
        raise ConfigError(f"{target.path}: --partition writes folders: name one that ends with /")
    paths = recordings_in(files)
    written: list[dict[str, Any]] = []
    warnings: Counter[str] = Counter()
    without: list[str] = []
    first: EdorasError | None = None
    left_out = failed = 0
    with file_progress(files, quiet=printing.quiet or printing.json) as progress:
        for place, (path, name) in enumerate(zip(paths, recording_names([*map(str, paths)]), strict=True)):
            progress.step("exporting", place, len(paths))
            own, source = _Partition(target.path, target.format, target.folder, target.force, name), None
            try:
                source = open_topics([path], settings, scope)
                report = export(source, own, **how).summary()
                written += [{**item, "recording": name} for item in report["files"]]
                failure: EdorasError | None = source.failure
            except (CaptureError, RouteError) as error:
                first, failure = first or error, error
                if source and not (source.failure or source.damage):
                    without.append(name)
                    failure = None
            if isinstance(failure, InterruptError):
                raise failure
            failed += failure is not None
            warnings.update([*(source.notes if source else ()), *([str(failure)] if failure else ())])
            left_out += source.left_out if source else 0
    if first and not written:
        raise first
    lines = [f"{line} ({count:,} recordings)" if count > 1 else line for line, count in warnings.items()]
    if without:
        lines.append(f"{plural(len(without), 'recording')} without a message of these: {listed(without, 3)}")
    summary = {"source": listed([*map(str, files)], 3), "left_out": left_out, "warnings": lines}
    print_written({**summary, "files": written if printing.json else by_topic(written)}, printing)
    tell(*lines)
    if failed:
        raise CaptureError(f"{failed:,} of {plural(len(paths), 'recording')} could not be read whole")


def by_topic(files: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one entry per topic: its folder, and the number of rows in all recordings."""
    topics: dict[str, dict[str, Any]] = {}
    for item in files:
        whole = {**item, "path": f"{Path(item['path']).parents[1]}/", "rows": 0}
        topics.setdefault(item["topic"], whole)["rows"] += item["rows"]
    return [*topics.values()]
