"""The way of one message, and the rounds of a topic: as text, as Mermaid, as a picture and as a page."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec
import numpy as np
from rich.text import Text

from edoras_tools import words
from edoras_tools.addons.trace.tracing import MessageTrace, TraceRequest, TraceStep, Tracing
from edoras_tools.render import pages
from edoras_tools.render.capture.sequence import mermaid_text
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.text import clean, clip, fit, fit_right, wrap
from edoras_tools.words import NONE, plural

if TYPE_CHECKING:
    from edoras_tools.addons.trace.rounds import HopRate, Rounds, Timing, TopicRates
    from edoras_tools.decode import Context
    from edoras_tools.model import Columns, PacketBatch
    from edoras_tools.render.pages import Origin


_WIDEST: Final = 100
_TIME, _AFTER, _WITNESS = 13, 13, 8
_HEAD: Final = 9
"""Width of the line names in a diagram, in columns."""
COLUMNS_A_ROUND: Final = 10
"""Width of one round in a diagram, in columns."""


def title(trace: MessageTrace) -> str:
    """Return the title of a message: ``/cmd_vel (0x1827 on CI), message 25 of 600``."""
    if trace.link == "" or not trace.of:
        return clean(trace.topic or "a message")
    return clean(f"{name_on_link(trace)}, message {trace.nth:,} of {trace.of:,}")


def name_on_link(item: MessageTrace | Timing) -> str:
    """Return ``/cmd_vel (0x1827 on CI)``; ``0x1827 on CI`` if no mission names a topic."""
    which = f"0x{item.msg_id:04x} on {item.link.upper()}" if item.msg_id >= 0 else item.link.upper()
    return f"{item.topic} ({which})" if item.topic and item.topic[:2] != "0x" else which


def usual_text(trace: MessageTrace) -> str:
    """Return the time that the message took, and the usual time of others."""
    if trace.delay_ns is None:
        return ""
    took = "took" if trace.ended.ending in {"delivered", "sent_out"} else "followed for"
    text = f"{took} {_milliseconds(trace.delay_ns)}"
    text += "" if trace.delay_witness == "measured" else f" ({trace.delay_witness})"
    if trace.usual is None:
        return text
    usual = trace.usual
    p50, p99, most = map(words.milliseconds, (usual.p50, usual.p99, usual.most))
    return f"{text}; {usual.count:,} were measured: p50 {p50}, p99 {p99}, max {most}"


def ended_text(trace: MessageTrace) -> str:
    """Return the ending of the message, with its evidence."""
    ended = trace.ended
    where = f", at {ended.hop}" if ended.ending not in {"delivered", "sent_out", "lost"} else ""
    return f"{ended.text}{where} ({ended.witness})"


def is_lost(trace: MessageTrace) -> bool:
    """Return whether the message did not arrive, as far as known."""
    return trace.ended.ending in {"lost", "unaccounted"}


class LadderPart(NamedTuple):
    """One way of a message as a drawing.

    Attributes:
        trace: way.
        heading: text above it.
        shared: number of places in common with the first way, where they are drawn.
        rungs: text, time, time since the previous place, and place of each of the others.
    """

    trace: MessageTrace
    heading: str
    shared: int
    rungs: list[tuple[str, str, str, TraceStep]]


def ladder_parts(trace: MessageTrace, zero_ns: int) -> Iterator[LadderPart]:
    """Yield the ways of a message; times count from ``zero_ns``."""
    for way in (trace, *trace.also):
        rungs = []
        for step, after_ns in zip(way.steps, way.after_ns, strict=True):
            text = clean(step.text if step.packet is None else f"packet {step.packet:,}: {step.text}")
            when = "" if step.time_ns is None else f"{(step.time_ns - zero_ns) / 1e9:.6f} s"
            rungs.append((text, when, "" if after_ns is None else f"+{_milliseconds(after_ns)}", step))
        if way is trace:
            yield LadderPart(way, title(trace), 0, rungs)
            continue
        own = zip(trace.steps, way.steps, strict=False)
        shared = next((at for at, (one, other) in enumerate(own) if one != other), len(way.steps))
        yield LadderPart(way, "It also came out another way:", shared, rungs[shared:])


def ladder(trace: MessageTrace, zero_ns: int, width: int) -> list[Text]:
    """Return the way of a message, one rung for each place.

    Args:
        zero_ns: zero of the times, ns since 1970.
        width: width in columns.
    """
    width = min(width, _WIDEST)
    room = width - 2 - _TIME - _AFTER - 2 - _WITNESS
    lines: list[Text] = []
    for way in ladder_parts(trace, zero_ns):
        lines.append(Text(clip(way.heading, width), palette.STRONG))
        if way.trace is trace:
            head = f"  {fit('where', room)}{fit_right('time', _TIME)}{fit_right('after', _AFTER)}  known"
            lines.append(Text(head, palette.DIM))
        for text, when, after, step in way.rungs:
            line = Text(f"● {fit(clean(step.hop), room)}{fit_right(when, _TIME)}{fit_right(after, _AFTER)}  ")
            lines.append(line.append(step.witness, palette.DIM if step.witness == "unknown" else ""))
            lines += [Text(f"│   {part}", palette.DIM) for part in wrap(text, width - 4)]
        is_open, lost = way.trace.ended.ending == "open", is_lost(way.trace)
        style, mark = (Level.ERROR.style, "✗") if lost else ("", "?") if is_open else (palette.GOOD, "✓")
        for place, part in enumerate(wrap(clean(ended_text(way.trace)), width - 2)):
            lines.append(Text(f"{'  ' if place else f'{mark} '}{part}", style))
        if took := usual_text(way.trace):
            lines += [Text(f"  {part}") for part in wrap(clean(took), width - 2)]
    return lines


def _milliseconds(value_ns: int) -> str:
    """Return a time in ms, to the microsecond, so that the parts of a way add up."""
    return f"{value_ns / 1e6:,.3f} ms"


def trace_mermaid(trace: MessageTrace, zero_ns: int) -> Iterator[str]:
    """Yield the lines of a Mermaid sequence diagram."""
    yield "sequenceDiagram"
    for which, way in enumerate(ladder_parts(trace, zero_ns)):
        names = [f"W{which}P" if which and at >= way.shared else "P" for at in range(len(way.trace.steps))]
        names = [f"{name}{at}" for at, name in enumerate(names)]
        for name, (*_, step) in zip(names[way.shared :], way.rungs, strict=True):
            yield f"    participant {name} as {mermaid_text(step.hop)}"
        for place, (_, when, after, step) in enumerate(way.rungs, way.shared):
            if place:
                label = mermaid_text(f"{after} ({step.witness})".strip())
                yield f"    {names[place - 1]}->>{names[place]}: {label}"
            text = mermaid_text(", ".join(filter(None, (when, step.text))))
            yield f"    Note over {names[place]}: {text}"
        arrow = "-x" if is_lost(way.trace) else "->>"
        yield f"    {names[-1]}{arrow}{names[-1]}: {mermaid_text(ended_text(way.trace))}"


class TimingWindow(msgspec.Struct, frozen=True):
    """The part of a topic's rounds in a diagram.

    Attributes:
        rounds: all rounds.
        start_ns: begin, ns since 1970.
        end_ns: end, ns since 1970.
    """

    rounds: Rounds
    start_ns: int
    end_ns: int

    @classmethod
    def worst(cls, rounds: Rounds, count: int) -> TimingWindow:
        """Return the first window of ``count`` rounds in which most messages did not come out."""
        length = count * rounds.round_ns
        times, absent = rounds.time_ns, np.append(0, np.cumsum(~rounds.out))
        begins = rounds.wakes_ns if len(rounds.wakes_ns) else times
        first = np.searchsorted(times, begins)
        lost = absent[np.searchsorted(times, begins + length)] - absent[first]
        lost[first >= len(times)] = -1
        start = int(begins[int(lost.argmax())]) if rounds.visible and len(begins) else int(times[0])
        return cls(rounds, start, start + length)

    @property
    def messages(self) -> slice:
        """Messages in the window."""
        first, last = np.searchsorted(self.rounds.time_ns, (self.start_ns, self.end_ns))
        return slice(int(first), int(last))

    @property
    def wakes_ns(self) -> list[int]:
        """Wake-ups in the window."""
        wakes = self.rounds.wakes_ns
        return [int(item) for item in wakes[(wakes >= self.start_ns) & (wakes < self.end_ns)]]


def facts(timing: Timing) -> list[str]:
    """Return facts on the rounds of a topic, one line each."""
    rounds = timing.rounds
    reads = f"{rounds.queue} wakes up every {rounds.round_ns / 1e6:.0f} ms ({rounds.round_from})"
    lines = [f"{reads}; {rounds.limit} of this MsgId may wait in {rounds.pipe} ({rounds.limit_from})"]
    sizes = {kind: count for kind, count in rounds.sizes().items() if kind[0] < kind[1]}
    if not rounds.visible:
        lines.append(f"{plural(len(rounds), 'message')} sent; nothing here shows which came out")
        return lines
    if sizes:
        out, of = max(sizes, key=lambda kind: (sizes[kind], kind))
        every = f"{rounds.round_ns / 1e6:.0f} ms"
        lines.append(f"mostly {out} of {of} came out per {every}: in {plural(sizes[out, of], 'round')}")
    came = int(rounds.out.sum())
    rest = ", ".join(f"{number:,} {text}" for number, text in timing.endings)
    lines.append(f"{plural(len(rounds), 'message')}, {came:,} came out" + (f"; {rest}" if rest else ""))
    return lines


def diagram(timing: Timing, zero_ns: int, width: int) -> list[Text]:
    """Return a topic's wake-ups, waiting messages, and losses over time.

    Args:
        zero_ns: zero of the times, ns since 1970.
        width: width in columns.
    """
    width, rounds = min(width, _WIDEST), timing.rounds
    columns = width - _HEAD - 1
    window = TimingWindow.worst(rounds, max(1, columns // COLUMNS_A_ROUND))
    step = rounds.round_ns / COLUMNS_A_ROUND

    def column(time_ns: int) -> int:
        return min(columns - 1, int((time_ns - window.start_ns) / step))

    wakes, waits, marks = [" "] * columns, [" "] * columns, [" "] * columns
    for when in window.wakes_ns:
        wakes[column(when)] = "▲"
    depth = rounds.depth()
    for place in range(len(rounds))[window.messages]:
        at = column(int(rounds.time_ns[place]))
        mark = ("●" if rounds.out[place] else "✗") if rounds.visible else "·"
        marks[at] = "✗" if "✗" in {mark, marks[at]} else mark
        if len(rounds.wakes_ns):
            waits[at] = str(depth[place]) if depth[place] < 10 else "+"
    lines = [Text(clip(clean(name_on_link(timing)), width), palette.STRONG)]
    lines += [Text(part) for text in facts(timing) for part in wrap(clean(text), width)]
    begin = (window.start_ns - zero_ns) / 1e9
    lines += [Text(""), Text(f"from {begin:.3f} s, a column is {step / 1e6:.0f} ms", palette.DIM)]
    rows = {"wake-up": wakes, "waiting": waits, "message": marks}
    for head, cells in rows.items():
        if head == "message" or len(rounds.wakes_ns):
            line = Text(f"{fit(head, _HEAD)} ")
            for cell in cells:
                line.append(cell, Level.ERROR.style if cell == "✗" else "")
            line.rstrip()
            lines.append(line)
    key = "▲ wake-up   waiting: with this one   ● came out   ✗ did not" if rounds.visible else "· sent"
    return [*lines, Text(key, palette.DIM)]


def rate_lines(rates: TopicRates) -> list[str]:
    """Return the rates of a topic: all in one line, then one line for each hop."""
    every = ", ".join(f"{hop.hop} {_hertz(hop)}" for hop in rates.hops)
    msg_id, link = f"0x{rates.msg_id:04x}", rates.link.upper()
    name = f"{msg_id} on {link}" if rates.topic == msg_id else f"{rates.topic} ({msg_id} on {link})"
    lines = [clean(f"{name}: {every}")]
    head = "".join(item.rjust(11) for item in ("rate", "min", "max", "std dev", "messages"))
    lines.append(f"{'':<24}{head}")
    for hop in rates.hops:
        spread = [
            NONE if item is None else f"{item:.{digits}f} s"
            for item, digits in ((hop.least_s, 3), (hop.greatest_s, 3), (hop.deviation_s, 5))
        ]
        count = NONE if hop.count is None else f"{'' if hop.exact else 'about '}{hop.count:,}"
        cells = "".join(item.rjust(11) for item in (_hertz(hop), *spread, count))
        lines.append(f"{fit(clean(hop.hop), 24)}{cells}")
    return [*lines, f"of the last {plural(rates.window, 'message')}"]


def _hertz(hop: HopRate) -> str:
    return "not seen" if hop.rate_hz is None else f"{hop.rate_hz:.1f}"


def packet_ladder(
    context: Context,
    batches: Iterable[tuple[PacketBatch, Columns]],
    number: int,
    zero_ns: int,
    cancelled: Callable[[], bool],
) -> Callable[[int], list[Text]] | None:
    """Return a function of the width that draws the way of a packet's message; None if it was cancelled.

    Args:
        batches: batches of the whole capture.
        number: number of the packet in it, from 1.
        zero_ns: zero of the times, ns since 1970.
        cancelled: called before each batch.

    Raises:
        RouteError: the packet is no message of a link.
    """
    tracing = Tracing(context, TraceRequest(number))
    for batch, columns in batches:
        if cancelled():
            return None
        tracing.add(batch, columns)
    tracing.diagnose()
    tracing.check()
    assert tracing.trace is not None
    return partial(ladder, tracing.trace, zero_ns)


_RUNG: Final = 46
_ROUNDS: Final = 12
"""Number of rounds in a timing diagram."""
_KEY: Final = pages.colour_key((("note", "came out"), ("error", "did not"), ("rule", "wake-up")))


def standalone(svg: str) -> str:
    """Return a page's chart as a separate picture: light or dark like the reader's system."""
    style = (files("edoras_tools.render") / "pages.css").read_text(encoding="utf-8")
    head = '<svg xmlns="http://www.w3.org/2000/svg" font-family="sans-serif" style="background:var(--card)"'
    return (
        svg.replace("<svg", head, 1).replace(">", f"><style>{escape(style, quote=False)}</style>", 1) + "\n"
    )


def trace_picture(trace: MessageTrace, zero_ns: int) -> str:
    """Draw the way of a message as a ladder."""
    shapes, x, y, right = [], 20, 20, pages.CHART_WIDTH - 10
    for way in ladder_parts(trace, zero_ns):
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
        ended, is_open = clean(ended_text(way.trace)), way.trace.ended.ending == "open"
        style = "lossy" if is_lost(way.trace) else "open" if is_open else "good"
        shapes += [
            f'<circle class="ended {style}" cx="{x}" cy="{y}" r="8"/>',
            f'<text class="label" x="{x + 18}" y="{y + 4}">{escape(ended)}</text>',
            f'<text x="{x + 18}" y="{y + 20}">{escape(usual_text(way.trace))}</text>',
        ]
        y += _RUNG
    return pages.svg_box("".join(shapes), y - 12, f"{title(trace)}: {ended_text(trace)}")


def timing_picture(timing: Timing, zero_ns: int) -> str:
    """Draw a topic's wake-ups, the waiting messages, and those that do not come out."""
    rounds = timing.rounds
    window = TimingWindow.worst(rounds, _ROUNDS)
    span = pages.TimeSpan((window.start_ns - zero_ns) / 1e9, (window.end_ns - window.start_ns) / 1e9)
    depth, mine = rounds.depth(), window.messages
    seconds = (rounds.time_ns[mine] - window.start_ns) / 1e9
    inside = depth[mine] if len(rounds.wakes_ns) else depth[mine] * 0 + 1
    points = list(zip(seconds.tolist(), inside.tolist(), rounds.out[mine].tolist(), strict=True))
    most = max([rounds.limit, *inside.tolist()]) + 1
    name = name_on_link(timing)
    frame = pages.Frame(span, most, "messages", f"{name}: {'; '.join(facts(timing))}")
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


def trace_page(subject: MessageTrace | Timing, zero_ns: int, name: str, origin: Origin) -> str:
    """Return a page with the picture and its contents as text."""
    if isinstance(subject, MessageTrace):
        name_text, picture = title(subject), trace_picture(subject, zero_ns)
        lines = [line.plain for line in ladder(subject, zero_ns, 80)]
    else:
        name_text, picture = name_on_link(subject), f"{_KEY}{timing_picture(subject, zero_ns)}"
        lines = [line.plain for line in diagram(subject, zero_ns, 80)]
    text = f'<div class="scroll"><pre>{escape(chr(10).join(lines))}</pre></div>'
    body = [pages.heading(name), f'<figure class="chart">{picture}</figure>', text, pages.footer(origin)]
    return pages.document(f"{name_text}, {name}", body)
