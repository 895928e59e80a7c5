"""The proof of a capture: both losses beside each other, and both arrivals as a picture."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from rich.console import Group
from rich.text import Text

from edoras_tools.render.plot.figure import Figure, Panel, PlotLine
from edoras_tools.render.plot.terminal import plot_lines
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal.table import Column, build
from edoras_tools.units import SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import Any

    from rich.console import RenderableType

    from edoras_tools.addons.lab.proof.model import CaptureProof

_ROWS: Final = 6


def _range(key: str) -> Any:
    def text(row: Mapping[str, Any]) -> Text:
        low, high = row[key]
        return Text(f"{low:,}" if low == high else f"{low:,} to {high:,}")

    return text


_COLUMNS: Final = (
    Column("MsgId", lambda row: Text(row["name"]), justify="left", elastic=True),
    Column("Sent", lambda row: Text(f"{row['sent']:,}")),
    Column("Lost", _range("lost")),
    Column("By the model", _range("model")),
    Column("", lambda row: Text("" if row["explained"] else "departs", Level.ERROR.style), justify="left"),
)


def proof_view(proof: CaptureProof, zero_ns: int, width: int) -> RenderableType:
    """Return the proof for people."""
    if proof.not_modelled:
        return Text(f"Not modelled: {proof.not_modelled}.")
    start, end = proof.span
    parts: list[RenderableType] = [
        Text(f"From {start:.1f} to {end:.1f} s, and the same input through the emulated cFS:")
    ]
    if proof.rows:
        parts.append(build(_COLUMNS, [row.as_json() for row in proof.rows], width))
        parts += plot_lines(_figure(proof, zero_ns), width, colour=True, rows=_ROWS)
    outside = sum(row.outside for row in proof.rows)
    if outside:
        parts.append(Text(f"{plural(outside, 'more message')} lost outside cFS: the model has none of it."))
    return Group(*parts, *_sentences(proof))


def _sentences(proof: CaptureProof) -> list[Text]:
    odd = [row for row in proof.rows if not row.explained]
    if odd:
        places = ", ".join(row.name for row in odd)
        return [Text(f"This model does not explain this capture; it departs at {places}.", Level.ERROR.style)]
    inside = any(row.lost[1] or row.model[1] for row in proof.rows)
    sentence = (
        "This model explains what was lost." if inside else "Nothing was lost inside cFS, nor by the model."
    )
    sentences = [Text(sentence, "green")]
    if proof.promised is not None:
        low, high = proof.remains
        number = f"{low:,}" if low == high else f"{low:,} to {high:,}"
        style = "green" if proof.keeps_promise else Level.ERROR.style
        sentences.append(
            Text(
                f"With the advice ({proof.remedy}) it loses {number}; {proof.promised:,} were promised.",
                style,
            )
        )
    return sentences


def _figure(proof: CaptureProof, zero_ns: int) -> Figure:
    """Draw how many of the MsgId that lost most had arrived by when, in the capture and in the model."""
    worst = max(proof.rows, key=lambda row: row.lost[0])

    def line(label: str, times_ns: Sequence[int], colour: int) -> PlotLine:
        times = (np.sort(np.array(times_ns, np.int64)) - zero_ns) / SECOND
        times = times[(times >= proof.span[0]) & (times <= proof.span[1])]
        return PlotLine(label, 0, times, np.arange(1.0, len(times) + 1), len(times), colour=colour)

    lines = [
        line("capture", proof.seen_ns.get(worst.msg_id, ()), 0),
        line("model", proof.run.arrived_ns.get(worst.msg_id, ()), 1),
    ]
    panel = Panel(
        f"{worst.name}: arrived so far", [item for item in lines if len(item.values)], from_zero=True
    )
    return Figure(("",), (panel,), proof.span)
