"""The options of all commands that write a recording, and the target that they name."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from time import time_ns
from typing import TYPE_CHECKING, Annotated

from typer import Option, echo

from edoras_tools.cli import options
from edoras_tools.cli.output import tell
from edoras_tools.io.formats.table import WRITTEN
from edoras_tools.io.outputs import STDOUT, check_new, write_bytes

if TYPE_CHECKING:
    from edoras_tools.io.formats.mcap.recovery.records import KnownTopics
    from edoras_tools.pipelines.capture.record import Target
    from edoras_tools.render.pages import Origin


Output = Annotated[
    Path | None,
    Option(
        "--output",
        "-o",
        parser=options.recording_path,
        metavar="FILE",
        help=f"Record to FILE; {WRITTEN} sets the format; %Y%m%d_%H%M%S in its name becomes the time.",
    ),
]
Force = Annotated[bool, Option("--force", help="Overwrite an existing output.")]


def known_topics(config: Sequence[Path] | None) -> KnownTopics:
    """Return the topics that a recording with these missions has.

    Raises:
        ConfigError: a mission has errors.
    """
    from edoras_tools.io.formats.mcap.recovery.records import KnownTopics
    from edoras_tools.pipelines.workbench import Settings

    if not config:
        return KnownTopics()
    bench = Settings(tuple(config)).workbench()
    return KnownTopics(bench.mission, bench.types)


def recording_target(output: Path | None, *, force: bool, inputs: Sequence[Path] = ()) -> Target | None:
    """Return the target of an output, checked before anything is opened; None without an output.

    Raises:
        ConfigError: its suffix is unknown, it is an input, or it exists.
    """
    if output is None:
        return None
    from edoras_tools.pipelines.capture.record import Target, check_output

    target = Target(output, replace=force, on_warning=tell)
    check_output(target, inputs)
    return target


def text_output(output: Path | None, inputs: Sequence[Path] = (), *, force: bool) -> Path | None:
    """Return the path of a text output, checked before anything is read; None for standard output or ``-``.

    Raises:
        ConfigError: it is an input, or it exists.
    """
    if output is None or output == STDOUT:
        return None
    check_new(output, inputs, force=force)
    return output


def put_text(text: str, output: Path | None) -> None:
    """Write a text to the path that ``text_output`` returned."""
    if output is None:
        echo(text, nl=False)
    else:
        write_page(text, output)


def page_origin() -> Origin:
    """Return by which command a page is made, and when."""
    from edoras_tools.render.pages import Origin

    return Origin(shlex.join(["edoras", *sys.argv[1:]]), time_ns())


def write_page(page: str | bytes, output: Path) -> int:
    """Write a page, a text or a picture, and missing folders; return its size in bytes.

    Raises:
        CaptureError: it cannot be written.
    """
    data = page if isinstance(page, bytes) else page.encode("utf-8", "replace")
    write_bytes(output, data, folders=True)
    return len(data)
