"""``edoras xtce``: the packets of a mission for ground systems."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from typer import Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.output import tell
from edoras_tools.older import StrEnum


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
