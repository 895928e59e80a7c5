"""``edoras codegen``: messages in C for flight software."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, NamedTuple

import typer

from edoras_tools.cli import options
from edoras_tools.cli.declare import grouped


class FolderOptions(NamedTuple):
    """Where the files go."""

    output: Annotated[
        Path | None, "--output -o DIR", "Folder for the files; default: edoras_msgs, or edoras_gen."
    ] = None
    force: Annotated[bool, "Overwrite what an earlier run generated, and remove the rest of it."] = False


class BoundOptions(NamedTuple):
    """The largest sizes of a message."""

    bound: Annotated[
        list[str] | None,
        "TYPE.FIELD=N",
        "Maximum elements of a sequence, or characters of a string; TYPE.FIELD[]=N for each "
        "string in a sequence; repeatable.",
    ] = None
    strings: Annotated[int, typer.Option(min=1), "N", "Maximum characters of other strings."] = 64
    sequences: Annotated[int, typer.Option(min=1), "N", "Maximum elements of other sequences."] = 32


class CoreOptions(NamedTuple):
    """How the functions of edoras_core behave."""

    pool: Annotated[
        int, typer.Option(min=1), "N", "Messages of one type that can be in use at the same time."
    ] = 4
    envelope: Annotated[str, "FORMAT", "EDORAS envelope: 8/8, 4/4 or 1/1, with le or be."] = "8/8 le"
    keep_values: Annotated[
        bool, "A get_ function that fails leaves the app's variable as it was; by default it writes 0."
    ] = False


@grouped
def codegen(
    *,
    types: Annotated[
        list[str] | None,
        typer.Argument(),
        "[TYPE]...",
        "Message types, e.g. geometry_msgs/msg/Twist; a package name stands for all its types. "
        "Or generator: a cFS app that publishes on command, for edoras sweep.",
    ] = None,
    folder: FolderOptions,
    config: options.Config = None,
    bounds: BoundOptions,
    core: CoreOptions,
    definitions: options.TypeOptions,
    command_mid: Annotated[options.MsgId, "generator: MsgId of its command; default 0x18F0."] = None,
    quiet: options.Quiet = False,
) -> None:
    """Write messages in C for flight software: no ROS, no heap.

    For example: edoras codegen -c MISSION --bound sensor_msgs/msg/JointState.name=16 -o fsw/src/edoras_msgs
    """
    from edoras_tools.addons.codegen.bounds import BoundRule, Bounds
    from edoras_tools.addons.codegen.generation import LibraryOrder, generate
    from edoras_tools.addons.codegen.generator import generator_app
    from edoras_tools.addons.codegen.summary import app_summary, summary
    from edoras_tools.addons.codegen.writing import write_folder
    from edoras_tools.cfs.profile import GENERATOR_MSG_ID
    from edoras_tools.errors import ConfigError
    from edoras_tools.mission import load
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.envelope import EnvelopeFormat

    if types == ["generator"] and not config:
        output = folder.output or Path("edoras_gen")
        made_app = generator_app(GENERATOR_MSG_ID if command_mid is None else command_mid)
        removed = write_folder(output, made_app, force=folder.force)
        if not quiet:
            sys.stdout.write("".join(f"{line}\n" for line in app_summary(made_app, output)))
        return
    if command_mid is not None:
        raise ConfigError("--command-mid is an option of 'edoras codegen generator'")
    output = folder.output or Path("edoras_msgs")
    store = TypeStore(definitions.distro or options.DISTRO, definitions.msg_path or ())
    mission = load(config or (), check_type=store.check)
    rules = tuple(BoundRule.read(text) for text in bounds.bound or ())
    order = LibraryOrder(
        tuple(types or ()),
        Bounds(bounds.strings, bounds.sequences, rules),
        mission,
        core.pool,
        EnvelopeFormat.named(core.envelope),
        keep_values=core.keep_values,
    )
    made = generate(store, order)
    removed = write_folder(output, made.files, force=folder.force)
    if not quiet:
        sys.stdout.write("".join(f"{line}\n" for line in summary(made, output, removed)))
