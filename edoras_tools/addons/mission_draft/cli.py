"""``edoras mission``: mission files, which say which topic travels under which MsgId."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.main import Command, command_group
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, file_progress, tell
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from edoras_tools.addons.mission_draft.draft import MissionDraft

mission = command_group("mission", "Draft a mission file from what is in a capture.")
Output = Annotated[Path | None, Option("--output", "-o", help="Default: standard output.")]


@mission.command(cls=Command)
@grouped
def draft(
    *,
    files: FileOptions,
    output: Output = None,
    force: recordings.Force = False,
    quiet: options.Quiet = False,
    decoding: options.DecodingOptions,
) -> None:
    """Draft a mission file from a capture: MsgIds, addresses, and the types that fit.

    What -c names is left out. The names of topics are made from MsgIds: edit them. Of several spacecraft
    each has a file of its own: NAME.yaml, NAME_sc_2.yaml.
    """
    from edoras_tools.addons.mission_draft.draft import CapturedTraffic, each_draft, read_traffic

    paths = files.required()
    output = recordings.text_output(output, paths, force=force)
    with file_progress(paths, quiet=quiet) as bar:
        opened, again = partial(open_input, InputOptions(files)), "-" not in map(str, paths)
        captured, _ = read_traffic(opened, decoding.settings(), bar, again=again)
    drafts = each_draft(captured, CapturedTraffic.draft)
    _end(drafts, paths, output, force=force, quiet=quiet)


@mission.command(cls=Command)
@grouped
def learn(
    *,
    files: FileOptions,
    output: Output = None,
    force: Annotated[bool, Option("--force", hidden=True)] = False,
    quiet: options.Quiet = False,
    decoding: options.DecodingOptions,
) -> None:
    """Learn a system from captures: a draft with ports, headers, rounds, depths and limits of its cFS.

    Each with its interval and what shows it; what nothing shows is missing. -c takes the file: doctor, check,
    --predict and sweep go by it, and edoras sim -c emulates the system. Of several spacecraft each has a file
    of its own: NAME.yaml, NAME_sc_2.yaml.
    """
    from edoras_tools.addons.mission_draft.learn import learn_mission

    paths = files.required()
    if "-" in map(str, paths):
        raise ConfigError("learn reads the captures several times, so it needs files, not stdin: name files")
    output = recordings.text_output(output, paths, force=force)
    with file_progress(paths, quiet=quiet) as bar:
        opened = partial(open_input, InputOptions(files), aligned=True, progress=bar)
        drafts = learn_mission(opened, decoding.settings(), bar)
    _end(drafts, paths, output, force=force, quiet=quiet)


def _end(
    drafts: Mapping[str, MissionDraft], inputs: list[Path], output: Path | None, *, force: bool, quiet: bool
) -> None:
    """Write the draft of each spacecraft, and print its summary and notes."""
    from edoras_tools.words import plural

    outputs = [
        recordings.text_output(
            output and (output.with_stem(f"{output.stem}_{prefix}") if place else output), inputs, force=force
        )
        for place, prefix in enumerate(drafts)
    ]
    for (prefix, made), path in zip(drafts.items(), outputs, strict=True):
        recordings.put_text(made.text, path)
        for note in () if quiet else made.notes:
            tell(f"{prefix}: {note}" if prefix else note)
        if path is not None and not quiet:
            learned = f", {plural(made.constants, 'constant')} of cFS" if made.constants else ""
            check = f"; several types fit {made.topics - made.sure} of them: check these" * bool(made.topics)
            tell(f"{path}: {plural(made.topics, 'topic')}{learned}{check}")
    for made in drafts.values():
        end(failure=made.failure)
