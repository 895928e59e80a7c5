"""The proof of a capture: the losses of both side by side, and as a picture over time, by place."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from edoras_tools.addons.lab.proof import HOSTS, CaptureProof, ModelRun
from edoras_tools.render.plot.figure import Figure, Panel, PlotLine
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.plot.terminal import plot_lines
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import Column, build
from edoras_tools.units import MICROSECOND, SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence


_ROWS: Final = 6
_PANELS: Final = 3
"""Places that are drawn: those with most losses."""


def _between(low: float, high: float) -> str:
    return f"{low:,.0f}" if low == high else f"{low:,.0f} to {high:,.0f}"


_COLUMNS: Final = (
    Column("MsgId", lambda row: Text(row["name"]), justify="left", elastic=True),
    Column("Sent", lambda row: Text(f"{row['sent']:,}")),
    Column("Lost", lambda row: Text(_between(*row["lost"]))),
    Column("By the model", lambda row: Text(_between(*row["model"]))),
    Column("", lambda row: Text("" if row["explained"] else "departs", Level.ERROR.style), justify="left"),
)


def proof_view(proof: CaptureProof, zero_ns: int, width: int) -> RenderableType:
    """Return the view of a proof."""
    if proof.not_modelled:
        return Text(f"Not modelled: {proof.not_modelled}.")
    start, end = proof.span
    parts: list[RenderableType] = [
        Text(f"From {start:.1f} to {end:.1f} s, and the same input through the emulated cFS:")
    ]
    if proof.rows:
        parts.append(build(_COLUMNS, [row.as_json() for row in proof.rows], width))
        parts += plot_lines(_figure(proof, zero_ns, ""), width, colour=True, rows=_ROWS)
    return Group(*parts, *(Text(text, style) for text, style in _sentences(proof)))


def proof_picture(proof: CaptureProof, zero_ns: int, name: str) -> str:
    """Return the losses of the capture and the model over time, at each place, as SVG.

    Args:
        name: name of the capture.
    """
    return plot_svg(_figure(proof, zero_ns, name, [text for text, _ in _sentences(proof)]))


def _sentences(proof: CaptureProof) -> Iterator[tuple[str, str]]:
    """Yield the sentences on the proof, each with its style."""
    if outside := sum(row.outside for row in proof.rows):
        yield f"{plural(outside, 'more message')} lost outside cFS's queues: the model has none of it.", ""
    read = sorted(item.ci_read_ns / MICROSECOND for item in proof.hosts)
    wake = sorted(time_ns / MICROSECOND for item in proof.hosts for time_ns in item.latency_ns)
    reads, wakes = (_between(item[0], item[-1]) for item in (read, wake))
    source = HOSTS.get(proof.hosts[0], "given")
    text = f"Its host: CI reads a datagram in {reads} us, a task runs after {wakes} us ({source})."
    yield text, palette.DIM
    if odd := ", ".join(row.name for row in proof.rows if not row.explained):
        yield f"This model does not explain this capture; it departs at {odd}.", Level.ERROR.style
    elif any(row.lost[1] or row.model[1] for row in proof.rows):
        yield "This model explains what was lost.", "green"
    else:
        yield "Nothing was lost inside cFS, nor by the model.", "green"
    for item in proof.advices:
        text = f"{item.name}: {item.advice}: it loses {_between(*item.left)}; {item.promised:,} promised."
        yield text, "green" if item.keeps_promise else Level.ERROR.style


def _figure(proof: CaptureProof, zero_ns: int, name: str, notes: Sequence[str] = ()) -> Figure:
    """Draw the sum of losses over time at the worst places: in the capture, the model, and with an advice."""
    emulated = _places(proof.run)
    places = {*proof.lost_ns, *emulated}
    losses = {place: [proof.lost_ns.get(place, ()), emulated.get(place, ())] for place in places}
    worst = sorted(losses, key=lambda place: (-max(map(len, losses[place])), place))[:_PANELS]
    panels = []
    for place in worst or ["cFS"]:
        rows = dict(zip(("capture", "model"), losses.get(place, ((), ())), strict=True))
        cured = {item.advice: _places(item.run).get(place, ()) for item in proof.advices}
        best = min(cured, key=lambda remedy: len(cured[remedy]), default="")
        if cured and 2 * len(cured[best]) < len(rows["model"]):
            rows[f"model, {best}"] = cured[best]
        lines = [_line(proof, zero_ns, number, *row) for number, row in enumerate(rows.items())]
        panels.append(Panel(f"{place}: lost so far", lines, from_zero=True))
    return Figure((name,), panels, proof.span, notes=notes)


def _places(run: ModelRun) -> Mapping[str, Sequence[int]]:
    """Return the times of the losses by place."""
    places: dict[str, list[int]] = {}
    for (_, place), times_ns in run.lost_ns.items():
        places.setdefault(place, []).extend(times_ns)
    return places


def _line(proof: CaptureProof, zero_ns: int, number: int, label: str, times_ns: Sequence[int]) -> PlotLine:
    """Return the sum of losses over time; its number determines colour and dashes."""
    start, end = proof.span
    times = np.clip((np.sort(np.array(times_ns, np.int64)) - zero_ns) / SECOND, start, end)
    seconds = np.concatenate(([start], np.repeat(times, 2), [end]))
    count = np.repeat(np.arange(len(times) + 1.0), 2)
    return PlotLine(f"{label}: {len(times):,}", number, seconds, count, len(times), colour=number)
