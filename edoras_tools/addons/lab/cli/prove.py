"""``edoras doctor --prove``: the losses of a capture beside those of an emulated cFS with the same input."""

from __future__ import annotations

from typing import TYPE_CHECKING

from typer import Exit

from edoras_tools.addons.lab.proof import prove_capture
from edoras_tools.addons.lab.views.proof import proof_picture, proof_view
from edoras_tools.cli.inputs import InputOptions, open_input
from edoras_tools.cli.output import LOST, file_progress, print_json, print_view
from edoras_tools.errors import ConfigError
from edoras_tools.io.outputs import check_new, write_bytes

if TYPE_CHECKING:
    from edoras_tools.cli.doctor import TaskOptions
    from edoras_tools.cli.options import PrintOptions
    from edoras_tools.pipelines.workbench import Settings


def prove(inputs: InputOptions, settings: Settings, printing: PrintOptions, task: TaskOptions) -> None:
    """Prove a capture, and print the proof; with an output file, draw it too.

    Raises:
        ConfigError: the picture cannot be written.
        Exit: the model does not explain the losses, or an advice does not keep its promise.
    """
    output = task.output
    if output is not None:
        check_new(output, inputs.paths, force=task.force)
        if output.suffix.lower() != ".svg":
            raise ConfigError(f"{output}: the picture of --prove is SVG; name a file .svg")
    with file_progress(inputs.paths, quiet=printing.quiet or printing.json) as bar:
        diagnosis, proof = prove_capture(lambda: open_input(inputs, settings, aligned=True, progress=bar))
    if output is not None and not proof.not_modelled:
        picture = proof_picture(proof, diagnosis.zero_ns, " and ".join(item.name for item in inputs.paths))
        write_bytes(output, picture.encode())
    if printing.json:
        print_json(proof.as_json())
    else:
        print_view(lambda width: proof_view(proof, diagnosis.zero_ns, width))
    if not proof.explained or not all(item.keeps_promise for item in proof.advices):
        raise Exit(LOST)
