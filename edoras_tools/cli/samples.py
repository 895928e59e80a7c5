"""``edoras samples``: captures of a real cFS, missions and scenarios, as files of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Argument, echo

from edoras_tools.cli import recordings
from edoras_tools.cli.options import grouped
from edoras_tools.errors import CaptureError, ConfigError


@grouped
def samples(
    folder: Annotated[Path, Argument(metavar="DIR", help="A new folder for them.")],
    force: recordings.Force = False,
) -> None:
    """Copy captures, missions and scenarios to a folder."""
    from importlib.resources import as_file, files
    from shutil import rmtree

    from edoras_tools.io.outputs import write_files

    copies: dict[Path, bytes] = {}

    full = folder.is_dir() and any(folder.iterdir())
    if full and not force:
        raise ConfigError(
            f"{folder}: not an empty folder; name a new one, or --force overwrites what is in it"
        )
    try:
        with as_file(files("edoras_tools.samples")) as source:
            for path in sorted(source.rglob("*")):
                if path.is_file() and path.name != "__init__.py" and "__pycache__" not in path.parts:
                    copies[folder / path.relative_to(source)] = path.read_bytes()
        write_files(copies, force=force)
    except CaptureError:
        if not full:
            rmtree(folder, ignore_errors=True)
        raise
    count = sum(path.is_file() for path in folder.rglob("*"))
    command = f"edoras info {folder}/captures/a_rover.pcap -c {folder}/missions/rover_ground.yaml"
    echo(f"{folder}: {count} files; start with: {command}")
