"""``edoras mission``: mission files, which say which topic travels under which MsgId."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.endings import tell
from edoras_tools.cli.inputs import FileOptions, InputOptions, open_input
from edoras_tools.cli.main import Command, command_group
from edoras_tools.cli.output import file_progress

mission = command_group("mission", "Draft a mission file from what is in a capture.")


@mission.callback()
def _mission() -> None:
    """Keep ``draft`` a command of its own: typer drops the name of an only command."""


@mission.command(cls=Command)
@grouped
def draft(
    *,
    files: FileOptions,
    output: Annotated[Path | None, Option("--output", "-o", help="Default: standard output.")] = None,
    force: recordings.Force = False,
    quiet: options.Quiet = False,
    decoding: options.DecodingOptions,
) -> None:
    """Draft a mission file from a capture: MsgIds, addresses, and the types that fit.

    What -c names is left out. The names of topics are made from MsgIds: edit them.
    """
    from edoras_tools.addons.mission_draft.draft import draft_mission
    from edoras_tools.words import plural

    paths = files.named()
    output = recordings.text_output(output, paths, force=force)
    with file_progress(paths, quiet=quiet) as bar:
        source, bench = open_input(InputOptions(files), decoding.settings())
        made = draft_mission(source, bench, progress=bar)
    recordings.put_text(made.text, output)
    for note in () if quiet else made.notes:
        tell(note)
    if output is not None and not quiet:
        tell(
            f"{output}: {plural(made.topics, 'topic')}; several types fit {made.topics - made.sure} of them: "
            "check these"
        )
    if made.failure is not None:
        raise made.failure
