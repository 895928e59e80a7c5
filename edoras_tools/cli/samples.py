"""``edoras samples``: captures of a real cFS, missions and scenarios, as files of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from edoras_tools.cli import recordings
from edoras_tools.errors import CaptureError, ConfigError


def samples(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new folder for them.")],
    force: recordings.Force = False,
) -> None:
    """Copy the samples to a folder: captures, missions, scenarios."""
    from importlib.resources import as_file, files
    from shutil import Error, copytree, ignore_patterns

    if not force and folder.is_dir() and any(folder.iterdir()):
        raise ConfigError(
            f"{folder}: not an empty folder; name a new one, or --force overwrites what is in it"
        )
    try:
        with as_file(files("edoras_tools.samples")) as source:
            copytree(source, folder, ignore=ignore_patterns("__pycache__", "__init__.py"), dirs_exist_ok=True)
    except (OSError, Error) as error:
        raise CaptureError(
            f"{folder}: cannot be written: {getattr(error, 'strerror', None) or error}"
        ) from None
    count = sum(path.is_file() for path in folder.rglob("*"))
    command = f"edoras info {folder}/captures/a_rover.pcap -c {folder}/missions/rover_ground.yaml"
    typer.echo(f"{folder}: {count} files; start with: {command}")
