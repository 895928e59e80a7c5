"""``edoras codegen``: messages in C for flight software; ``edoras xtce``: packets for ground systems."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from typer import Argument, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import tell
from edoras_tools.older import StrEnum


class FolderOptions(NamedTuple):
    """Target of the files."""

    output: Annotated[Path | None, Option("--output", "-o", help="Default: edoras_msgs, edoras_gen.")] = None
    force: Annotated[bool, Option("--force", help="Replace what an earlier run generated.")] = False


class BoundOptions(NamedTuple):
    """Maximum sizes of a message."""

    bound: Annotated[
        list[str] | None,
        Option(
            metavar="TYPE.FIELD=N",
            help="Maximum elements of a sequence, or characters of a string; TYPE.FIELD[]=N for each "
            "string in a sequence; strings=64 and sequences=32 of all others.",
        ),
    ] = None
    strings: Annotated[int, Option(min=1, hidden=True)] = 64
    sequences: Annotated[int, Option(min=1, hidden=True)] = 32


class CoreOptions(NamedTuple):
    """Behaviour of the functions of edoras_core."""

    pool: Annotated[int, Option(min=1, help="Messages of one type that can be in use at the same time.")] = 4
    keep_values: Annotated[bool, Option("--keep-values", help="A get_ that fails changes nothing.")] = False


@grouped
def codegen(
    *,
    types: Annotated[
        list[str] | None,
        Argument(
            metavar="[TYPE]...",
            help="Message types, e.g. geometry_msgs/msg/Twist; a package name stands for all its types. "
            "Or generator: a cFS app that publishes on command, for edoras sweep.",
        ),
    ] = None,
    folder: FolderOptions,
    bounds: BoundOptions,
    core: CoreOptions,
    generator: Annotated[Any, Option(parser=options.msg_id, help="Its MsgId; default 0x18F0.")] = None,
    quiet: options.Quiet = False,
    decoding: options.DecodingOptions,
) -> None:
    """Write messages in C for flight software: no ROS or heap.

    For example: edoras codegen std_msgs/Header --bound std_msgs/Header.frame_id=16 -o edoras_msgs
    """
    from edoras_tools.addons.codegen.generation import LibraryOrder, generate, generator_app
    from edoras_tools.addons.codegen.plan import BoundRule, Bounds
    from edoras_tools.addons.codegen.writing import app_summary, summary, write_folder
    from edoras_tools.cfs.profile import GENERATOR_MSG_ID
    from edoras_tools.errors import ConfigError
    from edoras_tools.mission import load
    from edoras_tools.ros import TypeStore
    from edoras_tools.wire.envelope import EnvelopeFormat

    if types == ["generator"] and not decoding.config:
        output = folder.output or Path("edoras_gen")
        made_app = generator_app(GENERATOR_MSG_ID if generator is None else generator)
        removed = write_folder(output, made_app, force=folder.force)
        if not quiet:
            sys.stdout.write("".join(f"{line}\n" for line in app_summary(made_app, output)))
        return
    if generator is not None:
        raise ConfigError("--generator is an option of 'edoras codegen generator'")
    output = folder.output or Path("edoras_msgs")
    settings = decoding.settings()
    store = TypeStore(settings.distro, settings.msg_paths)
    mission = load(settings.configs, check_type=store.check)
    usual = {"strings": bounds.strings, "sequences": bounds.sequences}
    overrides = dict(text.split("=", 1) for text in bounds.bound or () if text.partition("=")[0] in usual)
    usual |= {name: options.count(text) for name, text in overrides.items()}
    rules = tuple(BoundRule.read(text) for text in bounds.bound or () if text.partition("=")[0] not in usual)
    envelope = EnvelopeFormat.of_name(settings.options.envelope or "8/8 le")
    if envelope.own or envelope.width == 2:
        raise ConfigError(f"--envelope {envelope}: the C code writes 8/8, 4/4 or 1/1; choose one of them")
    order = LibraryOrder(
        tuple(types or ()),
        Bounds(usual["strings"], usual["sequences"], rules),
        mission,
        core.pool,
        envelope,
        keep_values=core.keep_values,
    )
    result = generate(store, order)
    removed = write_folder(output, result.files, force=folder.force)
    if not quiet:
        sys.stdout.write("".join(f"{line}\n" for line in summary(result, output, removed)))


class GroundForm(StrEnum):
    """Languages that describe packets."""

    XTCE = "xtce"
    COSMOS = "cosmos"


@grouped
def xtce(
    *,
    output: Annotated[Path | None, Option("--output", "-o", help="Default: standard output.")] = None,
    form: Annotated[GroundForm, Option("--format", help="cosmos: a file for cmd_tlm/.")] = GroundForm.XTCE,
    system: Annotated[str, Option(help="Name of the space system, or the target.")] = "edoras",
    force: recordings.Force = False,
    quiet: options.Quiet = False,
    decoding: options.DecodingOptions,
) -> None:
    """Describe packets for ground systems: XTCE or COSMOS.

    Of the missions that -c names and the C structs of --set: telemetry of Telemetry Output and of cFE
    itself, field by field; commands to Command Ingest of fixed size.
    """
    from edoras_tools.addons.codegen.writing import describe_packets
    from edoras_tools.words import plural

    output = recordings.text_output(output, force=force)
    result = describe_packets(decoding.settings().workbench(), system, for_cosmos=form is GroundForm.COSMOS)
    recordings.put_text(result.text.decode(), output)
    if not quiet:
        tell(*result.notes)
        if output is not None:
            counts = f"{plural(result.telemetry, 'telemetry packet')}, {plural(result.commands, 'command')}"
            tell(f"{output}: {counts}")
