"""``edoras record``: live traffic or files into MCAP, rosbag2, pcapng or pcap."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import strftime
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import BadParameter, Option, echo

from edoras_tools import doors
from edoras_tools.cli import options, recordings
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.options import amount, grouped, headed, size
from edoras_tools.cli.output import Metrics, finish, measured, print_json, tell, watcher
from edoras_tools.errors import ConfigError
from edoras_tools.io.formats.table import FILE_SUFFIXES, WRITTEN, Format, written_as
from edoras_tools.io.outputs import STDOUT
from edoras_tools.words import listed

if TYPE_CHECKING:
    from edoras_tools.pipelines.capture.record import CaptureReport, Target


_KINDS = ("finding", "rule", "where")
_LEAST_BYTES = 1_000_000


def trigger(text: str) -> tuple[str, str]:
    """Read ``finding``, ``finding:NAME``, ``rule``, ``rule:ID`` or ``where:EXPR``; return kind and rest."""
    from edoras_tools.words import did_you_mean

    kind, colon, rest = text.partition(":")
    if kind not in _KINDS or (colon and not rest) or (kind == "where" and not rest):
        hint = "" if kind in _KINDS else did_you_mean(kind, _KINDS, 1)
        forms = "write finding, finding:NAME, rule, rule:ID or 'where:EXPR'"
        raise BadParameter(f"{text!r} is not a trigger; {hint or forms}")
    names: list[str] = []
    if kind == "where":
        options.where(rest)
    elif kind == "rule":
        from edoras_tools.diagnosis.rules import rules

        names = list(rules())
    else:
        from edoras_tools.model import Finding

        names = [item.label for item in Finding]
    if rest and names and rest not in names:
        hint = did_you_mean(rest, names, 1) or f"there are {', '.join(names)}"
        raise BadParameter(f"no {kind} is named {rest!r}; {hint}")
    return kind, rest


def span(text: str) -> tuple[str, int]:
    """Read a time or a size, as ``amount`` does."""
    return amount(f"{text}s" if text.isdecimal() else text)


@headed("Snapshots")
class SnapshotOptions(NamedTuple):
    """Settings for writing only the traffic around a trigger."""

    snapshot: Annotated[bool, Option("--snapshot", help="Write only what is around a trigger.")] = False
    before: Annotated[list[Any] | None, Option(parser=span, help="Kept before; default 30s and 512M.")] = None
    after: Annotated[int | None, Option(parser=options.duration, help="Kept after; default 10s.")] = None
    before_size: Annotated[int | None, Option(parser=size, hidden=True)] = None
    trigger: Annotated[
        list[Any] | None,
        Option(
            parser=trigger,
            help="What fires, beside t, Enter and signal USR1: finding[:NAME], rule[:ID] of the doctor, or "
            "'where:EXPR'.",
        ),
    ] = None
    socket: Annotated[Path | None, Option(help="Also fire when asked on this Unix socket.")] = None
    fire: Annotated[Path | None, Option(help="Only ask the recorder at this socket to fire.")] = None

    def check(self, *, splits: bool) -> None:
        """Refuse options that have no effect together.

        Raises:
            ConfigError: there are such options.
        """
        needs = [name for name, value in self._asdict().items() if value is not None and value is not False]
        needs = [f"--{name.replace('_', '-')}" for name in needs if name not in {"snapshot", "fire"}]
        if needs and not self.snapshot:
            raise ConfigError(f"{needs[0]} is an option of --snapshot: add --snapshot, or leave it out")
        if self.snapshot and splits:
            raise ConfigError("--snapshot writes a file for each trigger: leave the --split options out")
        if (self.before_size or dict(self.before or ()).get("size", _LEAST_BYTES)) < _LEAST_BYTES:
            raise ConfigError("--before is less than 1M: a batch of datagrams would not fit")


_FORMATS = ", ".join(suffix[1:] for suffix in FILE_SUFFIXES)


def stream_format(text: str) -> str:
    """Read the name of a recording's format."""
    if text != "rosbag2" and written_as(Path(f"x.{text}")) is None:
        raise BadParameter(f"{text!r} is not a format of recordings; use {_FORMATS}, rosbag2")
    return text


class TargetOptions(NamedTuple):
    """The files of a recording."""

    output: Annotated[
        Path | None,
        Option(
            "--output",
            "-o",
            parser=options.recording_path,
            metavar="FILE",
            help=f"Record to FILE; {WRITTEN} sets the format; %Y%m%d_%H%M%S in its name becomes the time; "
            "- is stdout.",
        ),
    ] = None
    force: recordings.Force = False
    stream: Annotated[
        str | None, Option("--format", parser=stream_format, help=f"rosbag2; with -o -: {_FORMATS}.")
    ] = None
    rosbag2: Annotated[bool, Option("--rosbag2", hidden=True)] = False
    tf: Annotated[bool, Option("--tf", help="Also write /tf, from the poses, for 3D views.")] = False
    split: Annotated[
        list[Any] | None, Option(parser=amount, help="Start a new file after 500M, 10m or 1000 packets.")
    ] = None
    split_size: Annotated[int | None, Option(parser=size, hidden=True)] = None
    split_time: Annotated[int | None, Option(parser=options.duration, hidden=True)] = None
    split_count: Annotated[int | None, Option(parser=options.count, hidden=True)] = None
    keep: Annotated[list[Any] | None, Option(parser=amount, help="Keep only the newest 5 or 20G.")] = None
    keep_size: Annotated[int | None, Option(parser=size, hidden=True)] = None
    jobs: options.Jobs = None
    after_split: Annotated[
        str | None, Option(metavar="'CMD {}'", help="Run for each complete file; tried again if it fails.")
    ] = None
    metrics: Metrics = None
    sync: Annotated[
        int | None,
        Option(parser=options.duration, metavar="[=TIME]", help="Flush to the disk each second, or TIME."),
    ] = None

    def merged(self) -> TargetOptions:
        """Return these options with the values of their old names.

        Raises:
            ConfigError: --keep is given a time.
        """
        split, keep = dict(self.split or ()), dict(self.keep or ())
        if "time" in keep:
            raise ConfigError("--keep takes a number of files or a size: 5 or 20G")
        return self._replace(
            rosbag2=self.rosbag2 or self.stream == "rosbag2",
            stream=None if self.stream == "rosbag2" else self.stream,
            split_size=self.split_size or split.get("size"),
            split_time=self.split_time or split.get("time"),
            split_count=self.split_count or split.get("count"),
            keep_size=self.keep_size or keep.get("size"),
        )


@grouped
def record(
    *,
    inputs: InputOptions,
    files: TargetOptions,
    stop: options.PartOptions,
    every: options.EveryPort = False,
    printing: options.PrintOptions,
    filters: options.SelectionOptions,
    decoding: options.DecodingOptions,
    snapshots: SnapshotOptions,
) -> None:
    """Record all datagrams, and ROS messages on their topics.

    Several inputs become one recording in time order. To convert it back: edoras record a.mcap -o b.pcap
    """
    if snapshots.fire:
        echo(doors.part("snapshots").fire(snapshots.fire))
        return
    from edoras_tools.pipelines.capture.record import check_output
    from edoras_tools.pipelines.capture.record import record as run

    live, limits = not inputs.paths, stop.limits(inputs.paths)
    if every and not inputs.live.interface:
        raise ConfigError("--all chooses what -i IFACE captures; files and --listen are recorded whole")
    files = files.merged()
    snapshots.check(splits=bool(files.split_size or files.split_time or files.split_count))
    around = doors.part("snapshots") if snapshots.snapshot else None
    target = _target(files, printing, "snapshot" if around else strftime("edoras_%Y%m%d_%H%M%S"))
    if around and files.rosbag2:
        raise ConfigError("--snapshot writes files, and --rosbag2 a directory: leave one of them out")
    if files.tf and target.format is not None and not target.format.messages:
        raise ConfigError(f"{target.path}: --tf writes a topic, and {target.format.name} has none: use .mcap")
    _check_named_last(inputs.paths, files.output)
    check_output(target, inputs.paths, snapshots=snapshots.snapshot)
    if files.after_split and not target.splits:
        raise ConfigError("--after-split is for a recording in parts: split too, e.g. --split 10m")
    written = None if target.stream else target.path
    source, bench = open_input(inputs, decoding.settings(), every_port=every, messages=True, output=written)
    if around and bench.mission.recorded:
        source.close()
        raise ConfigError(
            f"{source.info.name}: has messages and no datagrams, and a snapshot is of datagrams"
        )
    if around:
        around.record(source, bench, target, snapshots, filters.selection(), limits, printing)
        return
    after = doors.part("after_split")(files.after_split, tell) if files.after_split else None
    if after:
        target = replace(target, on_complete=after.add)
    show = watcher(source, written, quiet=printing.quiet or printing.json, live=live)
    with measured(show, files.metrics) as watch:
        report = run(
            source,
            bench,
            target,
            selection=filters.selection(),
            limits=limits,
            watcher=watch,
            by_route=printing.json or not printing.quiet or files.metrics is not None,
        )
    _print_report(report, printing)
    if after:
        after.end()
    finish(report, live=live)


def _print_report(report: CaptureReport, printing: options.PrintOptions) -> None:
    """Print the result of a recording."""
    if printing.json:
        print_json(
            {
                **report.summary(),
                "outputs": [str(item) for item in report.outputs],
                "deleted": {"files": report.keep.deleted, "datagrams": report.keep.datagrams},
            }
        )
    elif not printing.quiet and report.outputs:
        from edoras_tools.render.capture.watch import recorded

        sys.stderr.write(recorded(report.summary(), report.outputs, report.keep) + "\n")
        _print_unnamed(report.summary()["routes"], report.outputs[0])


def _print_unnamed(routes: Sequence[Mapping[str, Any]], output: Path) -> None:
    """Print advice if no message has a topic, because no mission has its MsgId."""
    unnamed = [row["msg_id"] for row in routes if "unknown_msg_id" in row["findings"]]
    if unnamed and not any(row["topic"] for row in routes):
        tell(
            f"no mission names {listed(unnamed)}: name its file with -c, or draft one: "
            f"edoras mission draft {output} -o mission.yaml"
        )


def _check_named_last(inputs: Sequence[Path], output: Path | None) -> None:
    """Refuse an output that is also an input.

    Raises:
        ConfigError: it is.
    """
    *files, last = inputs or [Path()]
    if files and output is None and not last.exists() and written_as(last) is not None:
        line = shlex.join(["edoras", "record", *map(str, files), "-o", str(last)])
        raise ConfigError(f"{last}: there is no such file; to write it: {line}")


def _stream(files: TargetOptions, printing: options.PrintOptions) -> Format | None:
    """Return the format on standard output; None if a file is written.

    Raises:
        ConfigError: standard output is a terminal, or is needed for the report.
    """
    if files.output != STDOUT:
        if files.stream:
            raise ConfigError("--format is for -o -, standard output; a file's suffix sets its format")
        return None
    if printing.json:
        raise ConfigError("-o - writes the recording where --json prints its report: leave one of them out")
    if sys.stdout.isatty():
        raise ConfigError("-o - writes the recording to a pipe or a file, and this is a terminal")
    return written_as(Path(f"x.{files.stream or 'mcap'}"))


def _target(files: TargetOptions, printing: options.PrintOptions, usual: str) -> Target:
    """Return the target; ``usual`` is the name without suffix if none is given."""
    from edoras_tools.pipelines.capture.record import Target

    return Target(
        files.output or Path(usual + ("" if files.rosbag2 else ".mcap")),
        rosbag2=files.rosbag2,
        stream=_stream(files, printing),
        split_bytes=files.split_size or 0,
        split_ns=files.split_time or 0,
        split_count=files.split_count or 0,
        keep_files=dict(files.keep or ()).get("count", 0),
        keep_bytes=files.keep_size or 0,
        sync_ns=files.sync or 0,
        replace=files.force,
        transforms=files.tf,
        jobs=files.jobs or 0,
        on_warning=tell,
    )
