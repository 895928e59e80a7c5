"""Pictures of the way of one message, and of the rounds of a topic."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Final

from edoras_tools.addons.trace import texts
from edoras_tools.addons.trace.tracer import MessageTrace
from edoras_tools.render.pages import charts, parts
from edoras_tools.render.terminal.text import clean, clip

if TYPE_CHECKING:
    from edoras_tools.addons.trace.rounds import Timing
    from edoras_tools.render.pages.parts import Made

_RUNG: Final = 46
_ROUNDS: Final = 12
"""Number of rounds in a timing diagram."""
_KEY: Final = parts.colour_key((("note", "came out"), ("error", "did not"), ("rule", "wake-up")))


def standalone(svg: str) -> str:
    """Return a page's chart as a separate picture: light or dark like the reader's system."""
    style = (files("edoras_tools.render.pages") / "style.css").read_text(encoding="utf-8")
    head = '<svg xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" style="background:var(--card)"'
    return (
        svg.replace("<svg", head, 1).replace(">", f"><style>{escape(style, quote=False)}</style>", 1) + "\n"
    )


def trace_picture(trace: MessageTrace, zero_ns: int) -> str:
    """Draw the way of a message as a ladder."""
    shapes, x, y, right = [], 20, 20, charts.CHART_WIDTH - 10
    for way in texts.ladder_parts(trace, zero_ns):
        shapes.append(f'<text class="label" x="10" y="{y}">{escape(way.heading)}</text>')
        y += 24
        for text, when, after, step in way.rungs:
            shapes += [
                f'<line class="rung" x1="{x}" x2="{x}" y1="{y}" y2="{y + _RUNG}"/>',
                f'<circle class="{step.witness.replace(" ", "-")}" cx="{x}" cy="{y}" r="6"/>',
                f'<text class="label" x="{x + 18}" y="{y + 4}">{escape(clean(step.hop))}</text>',
                f'<text x="{x + 18}" y="{y + 20}">{escape(clip(text, 100))}</text>',
                f'<text class="end" x="{right}" y="{y + 4}">{after}&#8195;{when}&#8195;{step.witness}</text>',
            ]
            y += _RUNG
        ended, is_open = clean(texts.ended_text(way.trace)), way.trace.ended.ending == "open"
        style = "lossy" if texts.is_lost(way.trace) else "open" if is_open else "good"
        shapes += [
            f'<circle class="ended {style}" cx="{x}" cy="{y}" r="8"/>',
            f'<text class="label" x="{x + 18}" y="{y + 4}">{escape(ended)}</text>',
            f'<text x="{x + 18}" y="{y + 20}">{escape(texts.usual_text(way.trace))}</text>',
        ]
        y += _RUNG
    return charts.svg_box("".join(shapes), y - 12, f"{texts.title(trace)}: {texts.ended_text(trace)}")


def timing_picture(timing: Timing, zero_ns: int) -> str:
    """Draw a topic's wake-ups, the waiting messages, and those that do not come out."""
    rounds = timing.rounds
    window = texts.TimingWindow.worst(rounds, _ROUNDS)
    span = charts.TimeSpan((window.start_ns - zero_ns) / 1e9, (window.end_ns - window.start_ns) / 1e9)
    depth, mine = rounds.depth(), window.messages
    seconds = (rounds.time_ns[mine] - window.start_ns) / 1e9
    inside = depth[mine] if len(rounds.wakes_ns) else depth[mine] * 0 + 1
    points = list(zip(seconds.tolist(), inside.tolist(), rounds.out[mine].tolist(), strict=True))
    most = max([rounds.limit, *inside.tolist()]) + 1
    name = texts.name_on_link(timing)
    frame = charts.Frame(span, most, "messages", f"{name}: {'; '.join(texts.facts(timing))}")
    for when in window.wakes_ns:
        frame.line([((when - window.start_ns) / 1e9, 0.0), ((when - window.start_ns) / 1e9, most)], "wake")
    if len(rounds.wakes_ns):
        frame.level(rounds.limit, "limit", f"{name}: {rounds.limit} may wait, {rounds.limit_from}")
    shift = 0.4 if len(rounds.wakes_ns) else 0.0
    frame.dots([(at, level) for at, level, out in points if out or not rounds.visible], "run")
    frame.dots([(at, level + shift) for at, level, out in points if not out and rounds.visible], "run lossy")
    return frame.svg()


def trace_svg(subject: MessageTrace | Timing, zero_ns: int, name: str) -> str:
    """Return a picture of a message's way, or of a topic's rounds.

    Args:
        zero_ns: zero of the times, ns since 1970.
        name: name of the capture.
    """
    picture = trace_picture if isinstance(subject, MessageTrace) else timing_picture
    drawn = picture(subject, zero_ns)  # type: ignore[arg-type]
    return standalone(drawn.replace('aria-label="', f'aria-label="{escape(name, quote=True)}, ', 1))


def trace_page(subject: MessageTrace | Timing, zero_ns: int, name: str, origin: Made) -> str:
    """Return a page with the picture and its contents as text."""
    if isinstance(subject, MessageTrace):
        title, picture = texts.title(subject), trace_picture(subject, zero_ns)
        lines = [line.plain for line in texts.ladder(subject, zero_ns, 80)]
    else:
        title, picture = texts.name_on_link(subject), f"{_KEY}{timing_picture(subject, zero_ns)}"
        lines = [line.plain for line in texts.diagram(subject, zero_ns, 80)]
    text = f'<div class="scroll"><pre>{escape(chr(10).join(lines))}</pre></div>'
    body = [parts.heading(name), f'<figure class="chart">{picture}</figure>', text, parts.footer(origin)]
    return parts.document(f"{title}, {name}", body)
