"""A running demo, and its result: messages sent and arrived, latency, positions of the robots; the tour.

Also the result of a sweep (its steps, a chart, and the limit), of an experiment (a row for each setting), and
the proof of a capture: the losses of both side by side, and as a picture over time, by place.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import pi
from typing import TYPE_CHECKING, Any, Final, TextIO

import numpy as np
from rich.console import Console, Group, RenderableType
from rich.text import Text

from edoras_tools import words
from edoras_tools.addons.lab.proof import HOSTS, CaptureProof, ModelRun
from edoras_tools.decode.lines import line_of
from edoras_tools.render.bridge import losses as bridge_losses
from edoras_tools.render.capture import tree
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.plot.figure import GREY, Figure, Panel, PlotLine
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.plot.terminal import draw_lines, plot_lines
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.live_table import LiveTable, Moment
from edoras_tools.render.terminal.palette import Terminal, detect_terminal, output_console
from edoras_tools.render.terminal.table import Column, build, count_cell, facts_grid, figure, one_line, plain
from edoras_tools.render.terminal.text import size_of
from edoras_tools.units import MICROSECOND, SECOND
from edoras_tools.words import plural

if TYPE_CHECKING:
    from pathlib import Path

    from rich.table import Table

    from edoras_tools.addons.lab.demo.run import Demo
    from edoras_tools.model import Decoded

_CHART_WIDTH: Final = 78


def sweep_outcome(summary: Mapping[str, Any], width: int) -> RenderableType:
    """Return the view of the result.

    Args:
        summary: in the shape of ``sweep --json``.
    """
    steps = sorted(summary["steps"], key=lambda step: (step["rate_hz"], step["size"]))
    parts: list[RenderableType] = []
    if steps:
        parts += [_steps(steps, width), Text()]
    if len(steps) > 1:
        parts += [*plot_lines(chart(summary), min(width, _CHART_WIDTH), colour=True), Text()]
    facts = facts_grid()
    name = (
        summary["route"] if summary["route"] == summary["msg_id"] else "{route} ({msg_id})".format(**summary)
    )
    facts.add_row("route", plain(f"{name}, {_sweep_way(summary)}"))
    facts.add_row("threshold", Text(threshold_line(summary), palette.STRONG))
    if summary["limiting_hop"]:
        facts.add_row("limiting hop", plain(summary["limiting_hop"], Level.ERROR.style))
        facts.add_row("reason", plain(summary["reason"]))
    for note in summary["notes"]:
        facts.add_row("note", plain(note))
    if summary["interrupted"]:
        facts.add_row("ended", "early, by Ctrl-C")
    return Group(*parts, facts)


def chart(summary: Mapping[str, Any], *subtitle: str) -> Figure:
    """Return the chart of delivered messages over the requested ones.

    Args:
        subtitle: line below the title.
    """
    by_size = summary["swept"] == "size"
    points: dict[bool, list[tuple[float, float]]] = {False: [], True: []}
    for step in summary["steps"]:
        share = step["delivered"] / step["sent"] if step["sent"] else 0.0
        x = step["size"] if by_size else step["rate_hz"]
        points[bool(step["lost"])].append((x, 100 * share if by_size else x * share))
    end = max((x for x, _ in points[False] + points[True]), default=1.0) or 1.0
    ideal, clean = (100.0 if by_size else end), summary["threshold_bytes" if by_size else "threshold_hz"]
    lines = [plot_line("what was asked for", [(0.0, 100.0 if by_size else 0.0), (end, ideal)], colour=GREY)]
    if clean is not None:
        lines.append(plot_line("threshold", [(clean, 0.0), (clean, ideal)], colour=2))
    lines.append(plot_line("all arrived", sorted(points[False]), colour=0, sign="●"))
    lines.append(plot_line("some were lost", sorted(points[True]), colour=1, sign="✗"))
    panel = Panel(
        f"{summary['route']}, {summary['msg_id']}",
        [item for item in lines if len(item.values)],
        "got through, %" if by_size else "got through, messages/s",
        from_zero=True,
    )
    across = "packet size, bytes" if by_size else "asked for, messages/s"
    return Figure(subtitle, [panel], (0.0, end), across=across)


def plot_line(label: str, points: Sequence[tuple[float, float]], **look: Any) -> PlotLine:
    """Return a line through points, given as x and y."""
    x, y = np.array(points, np.float64).reshape(-1, 2).T
    return PlotLine(label, 0 if "sign" in look else 1, x, y, len(points), **look)


def sweep_plan(summary: Mapping[str, Any]) -> RenderableType:
    """Return the view of ``--dry-run``."""
    facts = facts_grid()
    facts.add_row("route", plain(f"{summary['route']} ({summary['msg_id']}) over {summary['link'].upper()}"))
    rates, sizes = summary["rates_hz"], summary["sizes"]
    facts.add_row("rate", f"{rates[0]:,} to {rates[1]:,} Hz" if rates[0] != rates[1] else f"{rates[0]:,} Hz")
    facts.add_row(
        "size", f"{sizes[0]:,} to {sizes[1]:,} bytes" if sizes[0] != sizes[1] else f"{sizes[0]:,} bytes"
    )
    facts.add_row("step", words.duration(summary["step_s"]))
    facts.add_row("target", plain(summary["target"]))
    facts.add_row("listening", f"at {summary['listen']}")
    facts.add_row("would send", ", ".join(summary["sends"]))
    return facts


def threshold_line(summary: Mapping[str, Any]) -> str:
    """Return the limit in a line."""
    by_size = summary["swept"] == "size"
    unit = "bytes" if by_size else "Hz"
    good = summary["threshold_bytes" if by_size else "threshold_hz"]
    bad = summary["first_loss_bytes" if by_size else "first_loss_hz"]
    if good is not None:
        return f"between {good:,} and {bad:,} {unit}"
    if bad is not None:
        return f"below {bad:,} {unit}: the lowest that was tried lost something"
    values = [step["size" if by_size else "rate_hz"] for step in summary["steps"]]
    return f"none found: nothing was lost up to {max(values):,} {unit}" if values else "none found"


@contextmanager
def step_status(*, quiet: bool) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the present step on a terminal."""
    if quiet or not detect_terminal(sys.stderr).interactive:
        yield lambda _: None
        return

    def show(text: str) -> None:
        sys.stderr.write(f"\r\x1b[K{text} ...  Ctrl-C ends")
        sys.stderr.flush()

    try:
        yield show
    finally:
        sys.stderr.write("\r\x1b[K")
        sys.stderr.flush()


def _sweep_way(summary: Mapping[str, Any]) -> str:
    towards = "to cFS" if summary["to_cfs"] else "from cFS"
    where = f", emulated ({summary['emulated']})" if summary["emulated"] else ""
    return f"{towards} over {summary['link'].upper()}{where}"


def _steps(steps: list[Mapping[str, Any]], width: int) -> Table:
    def share(step: Mapping[str, Any]) -> Text:
        text = f"{100 * step['lost'] / step['sent']:.1f} %" if step["lost"] else ""
        return Text(text, Level.ERROR.style)

    columns = (
        Column("Rate", lambda step: Text(f"{step['rate_hz']:,} Hz")),
        Column("Size", lambda step: Text(f"{step['size']:,} B")),
        Column("Sent", lambda step: Text(words.count(step["sent"]))),
        Column("Delivered", lambda step: Text(words.count(step["delivered"]))),
        Column("Lost", figure("lost", Level.ERROR.style)),
        Column("Share", share, rank=1),
        Column("At", lambda step: plain(step["hop"] or ""), justify="left", elastic=True),
    )
    return build(columns, steps, width)


def cells_table(report: Mapping[str, Any], width: int) -> RenderableType:
    """Return a row for each cell and topic.

    Args:
        report: in the shape of ``experiment --json``.
    """
    rows = [{**cell, **topic} for cell in report["cells"] for topic in cell["topics"]]
    columns = (
        Column("Setting", lambda row: plain(row["cell"]), justify="left", elastic=True),
        Column("Runs", lambda row: plain(row["runs"])),
        Column("Topic", lambda row: plain(row["topic"]), justify="left"),
        Column("Lost", _interval_of("loss", lambda value: f"{value:.2%}")),
        Column("Hz", _interval_of("rate_hz", lambda value: f"{value:.3g}"), rank=2),
        Column("Delay", _interval_of("delay_ms", words.milliseconds), rank=1),
    )
    table = build(columns, rows, width, apart=lambda row: row["cell"])
    end = f"Mean of the runs, and 95 % interval of the mean of all possible runs. Files: {report['folder']}"
    return Group(table, Text(), plain(end, palette.DIM))


def _interval_of(name: str, text: Callable[[float], str]) -> Callable[[Mapping[str, Any]], Text]:
    def cell(row: Mapping[str, Any]) -> Text:
        interval = row[name]
        if interval is None:
            return plain(words.NONE)
        mean, low, high = (text(interval[key]) for key in ("mean", "low", "high"))
        return plain(mean if low == high else f"{mean} ({low} to {high})")

    return cell


class Guide:
    """Prints the tour while it runs.

    Args:
        out: output stream.
    """

    def __init__(self, out: TextIO, terminal: Terminal) -> None:
        self._out = out
        self._terminal = terminal
        self._paint = palette.Paint(terminal.colour)
        self._list = PacketList(terminal.width, colour=terminal.colour)
        self._seen: set[tuple[object, ...]] = set()
        self._command: Decoded | None = None

    def begin(self, seconds: float, folder: Path) -> None:
        """Print the introduction: how long the link runs, and where its files will be."""
        self._title(
            1, f"A live link, {seconds:g} s of it: emulated cFS, two rovers, both bridges; one of each kind"
        )
        rovers = f"{folder}/missions/two_rovers"
        self._say(f"$ edoras sniff -i lo -c {rovers}_ground.yaml -c {rovers}_flight.yaml")
        self._line(self._list.header())

    def notice(self, text: str) -> None:
        """Print a note on this machine."""
        self._say(text)

    def packet(self, decoded: Decoded) -> None:
        """Print the first packet of each kind, and each event of cFS once."""
        self._command = self._command or (decoded if decoded.message and decoded.link.only_to_cfs else None)
        network, space = decoded.layer("sbn"), decoded.layer("ccsds")
        kind = (
            decoded.link,
            network.values()["msg_type"] if network else None,
            space.values()["msg_id"] if space else None,
            decoded.summary if decoded.layer("cfe_event") else "",
        )
        line = self._list.line(line_of(decoded))
        if kind not in self._seen:
            self._seen.add(kind)
            self._line(line)

    def end(self, live: Mapping[str, Any], real: Mapping[str, Any], folder: Path) -> None:
        """Print the contents of the recordings, one packet decoded, and the next commands to try."""
        if self._command is not None:
            self._title(2, "One command, every layer")
            self._say(f"$ edoras decode {folder}/two_rovers.mcap {self._command.datagram.number}")
            for line in tree.packet_lines(self._command, self._terminal.width, colour=self._terminal.colour):
                self._line(line)
        console = output_console()
        self._title(3, "What was recorded")
        self._say(f"$ edoras info {folder}/two_rovers.mcap")
        console.print(capture_summary(live, explain=False))
        self._title(4, "A capture of a real cFS")
        self._say(
            f"$ edoras record {folder}/a_rover.pcap -c {folder}/missions/rover_ground.yaml "
            f"-o {folder}/a_rover.mcap"
        )
        console.print(capture_summary(real))
        self._title(5, "What to do next")
        for line in (
            f"Foxglove         open {folder}/two_rovers.mcap, then its layout {folder}/foxglove_layout.json",
            "your own link    edoras sniff -i eth0 -c your_bridge.yaml",
            "                 edoras record -i eth0 -c your_bridge.yaml -o flight.mcap",
            f"back to a pcap   edoras record {folder}/a_rover.mcap -o back.pcap",
            f"what went wrong  edoras doctor {folder}/a_rover.mcap",
            "an emulated cFS  edoras sim two-rovers --rate 10   and in another terminal: edoras sniff -i lo",
        ):
            self._line(f"  {line}")

    def _title(self, number: int, text: str) -> None:
        self._line("")
        self._line(self._paint(f"{number}. {text}", palette.STRONG))

    def _say(self, text: str) -> None:
        self._line(self._paint(f"   {text}", palette.DIM))

    def _line(self, text: str) -> None:
        self._out.write(f"{text}\n")
        self._out.flush()


COLOURS: Final = ("cyan", "yellow")
"""Colours of the first and the second robot."""
_ARROWS: Final = "→↗↑↖←↙↓↘"
_BAR: Final = 24
_EIGHTHS: Final = " ▏▎▍▌▋▊▉█"


def draw_tracks(
    robots: Sequence[tuple[Sequence[tuple[float, float]], Sequence[float]]], width: int, height: int
) -> list[Text]:
    """Draw the tracks and positions of rovers, as large as possible.

    Args:
        robots: track of each robot, m, and its place: x, y, heading; the place may be empty.
        width: cells.
        height: lines.
    """
    points = [point for track, _ in robots for point in track]
    if not points:
        return [Text("waiting for the first pose ...", palette.DIM)]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    # A metre has the same length across and up: a dot is as wide as high.
    across, up = 2 * width, 4 * height
    scale = max(*(high - low) / (max(across - 5, 1), max(up - 5, 1)), 0.02)
    left, bottom = (low + high - scale * np.array([across - 1, up - 1])) / 2
    coloured = list(zip(robots, COLOURS, strict=False))
    lines = [(plot_line("", track), colour) for (track, _), colour in coloured if track]
    for (_, place), colour in coloured:
        if len(place) == 3:
            arrow = _ARROWS[round(place[2] / (pi / 4)) % 8]
            lines.append((plot_line("", [(place[0], place[1])], sign=arrow), f"bold {colour}"))
    span, ends = (left, left + scale * (across - 1)), (bottom, bottom + scale * (up - 1))
    return list(draw_lines(lines, span, ends, (height, width)))


def joints(robots: Sequence[tuple[str, Sequence[float]]]) -> list[Text]:
    """Draw the joints of arms side by side, one bar each; half a turn either way is a whole bar.

    Args:
        robots: name of each robot, and its joints, rad, perhaps none.
    """
    most = max((len(place) for _, place in robots), default=0)
    if not most:
        return [Text("waiting for the first joint state ...", palette.DIM)]
    head = Text(no_wrap=True)
    lines = [Text(no_wrap=True) for _ in range(most)]
    for (name, place), colour in zip(robots, COLOURS, strict=False):
        head.append(f"{name:<{_BAR + 18}}", palette.DIM)
        for index, line in enumerate(lines):
            value = place[index] if index < len(place) else 0.0
            share = min(abs(value) / pi, 1.0) * _BAR
            whole = int(share)
            bar = "█" * whole + _EIGHTHS[round((share - whole) * 8)].strip()
            line.append(f"joint {index + 2} ", palette.DIM)
            line.append(f"{value:6.2f} ")
            line.append(f"{bar:<{_BAR}}", colour)
            line.append("   ")
    for line in lines:
        line.rstrip()
    head.rstrip()
    return [head, *lines] if len(robots) > 1 else lines


_EVENTS: Final = 3
_PICTURE: Final = (76, 9)
_LEGS: Final = ("commands", "states")


def live_table(console: Console, output: Path) -> LiveTable[Demo]:
    """Return the view of a demo while it runs."""
    return LiveTable(_show, _counts, console, output)


def _counts(summary: Mapping[str, Any]) -> dict[object, int]:
    return {
        (robot["robot"], leg, name): robot[leg][name]
        for robot in summary["robots"]
        for leg in _LEGS
        for name in ("said", "arrived")
    }


def _show(demo: Demo, moment: Moment) -> Group:
    return Group(
        *_view(moment, demo.tracks),
        Text(),
        *(one_line(plain(line, palette.DIM)) for line in list(demo.events)[-_EVENTS:]),
        one_line(Text(beside(moment.summary), palette.DIM)),
        Text("Ctrl-C ends", palette.DIM),
    )


def outcome(
    summary: Mapping[str, Any], lines: Sequence[Sequence[tuple[float, float]]], width: int, output: Path
) -> Group:
    """Return the result of a demo.

    Args:
        summary: in the shape of ``demo SCENARIO --json``.
        lines: track of each rover.
    """
    return Group(
        *_view(Moment(summary, written=size_of(output), width=width), lines),
        Text(),
        *map(plain, (*moved(summary), *loss_lines(summary), "", *hints(summary))),
    )


def moved(summary: Mapping[str, Any]) -> list[str]:
    """Return a line for each robot: its commands and how far it moved."""
    lines = []
    for robot in summary["robots"]:
        commands, place = robot["commands"], robot["place"]
        by = f"{plural(commands['said'], 'command')} of the ground station"
        if commands["others_said"]:
            by += f", {commands['others_said']:,} of other nodes"
        reached = commands["arrived"] + commands["of_others"]
        line = f"{robot['robot']}: {by}; {reached:,} reached it"
        if len(place) == 3:
            line += f"; it drove {robot['way']:.1f} m, to x {place[0]:.2f}, y {place[1]:.2f}"
        elif place:
            line += f"; its joints turned {robot['way']:.1f} rad together"
        else:
            line += "; no state of it arrived"
        lines.append(line)
    return lines


def loss_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return lines on messages that did not arrive, with the reason."""
    lines = []
    for robot in summary["robots"]:
        for leg in _LEGS:
            row = robot[leg]
            name = f"{robot['robot']}: {leg}"
            lines += [
                f"{name}: {count:,} lost inside cFS: {pipe} takes no more of one MsgId at a time"
                for pipe, count in row["lost"].items()
            ]
            if row["replaced"]:
                lines.append(
                    f"{name}: {row['replaced']:,} replaced by newer ones: the flight application sends the "
                    "last on each wake-up"
                )
            if row["held"]:
                lines.append(
                    f"{name}: {row['held']:,} of {row['said']:,} held back by the bridge's rate limit"
                )
            absent = sum(row["lost"].values()) + row["refused"] + row["replaced"] + row["held"]
            missing = row["said"] - absent - row["arrived"]
            if missing > 0 and not robot["commands"]["others_said"]:
                lines.append(f"{name}: {missing:,} on their way at the end, or from before telemetry was on")
    return lines + bridge_losses(
        {"bridges": summary["bridges"], "inbox_overflowed": 0, "unrecorded": summary["unrecorded"]}
    )


def beside(summary: Mapping[str, Any]) -> str:
    """Return the command that shows the same links in another terminal."""
    ports = summary["ports"]
    names = {"ci": ports["ci"], "to": ports["to"]} | ({"sbn": ports["sbn"]} if "sbn" in ports else {})
    return "in another terminal: edoras sniff -i lo " + " ".join(
        f"--set port={name}:{port}" for name, port in names.items()
    )


def hints(summary: Mapping[str, Any]) -> list[str]:
    """Return commands to try next, one line each."""
    output = summary["output"]
    return [
        f"what was lost and why   edoras doctor {output}",
        f"every packet            edoras sniff -r {output}",
        f"all in one page         edoras report {output}",
        f"Foxglove                open {output}, then its layout {summary['layout']}",
        f"                        or play it there: edoras live {output}",
    ]


def _view(moment: Moment, lines: Sequence[Sequence[tuple[float, float]]]) -> list[RenderableType]:
    summary, width = moment.summary, moment.width
    return [
        _head(summary, moment.written or 0),
        Text(),
        _table(summary, width, moment.rates),
        Text(),
        *_picture(summary, lines, width),
    ]


def _head(summary: Mapping[str, Any], written: int) -> Text:
    head = plain(f"demo {summary['demo']}, ROS 2 through {summary['ros']}", palette.STRONG)
    head.append(f"   {words.duration(summary['seconds'])}", palette.DIM)
    head.append(f"   {summary['output']}: {plural(summary['recorded'], 'datagram')}", palette.DIM)
    head.append(f", {words.size(written)}", palette.DIM)
    if summary["foxglove"]:
        clients = len(summary["foxglove"]["clients"])
        head.append(f"   Foxglove {summary['foxglove']['url']}: {plural(clients, 'client')}", palette.DIM)
    return one_line(head)


def _table(summary: Mapping[str, Any], width: int, rates: Mapping[object, float] | None) -> RenderableType:
    rows = [
        {
            **robot[leg],
            "robot": robot["robot"],
            "leg": leg,
            "in": None if rates is None else rates.get((robot["robot"], leg, "said")),
            "out": None if rates is None else rates.get((robot["robot"], leg, "arrived")),
        }
        for leg in _LEGS
        for robot in summary["robots"]
    ]
    columns = [item for item in _COLUMNS if rates is not None or item.title not in {"in Hz", "out Hz"}]
    return build(columns, rows, width, apart=lambda row: row["leg"])


def _picture(
    summary: Mapping[str, Any], lines: Sequence[Sequence[tuple[float, float]]], width: int
) -> list[Text]:
    robots = summary["robots"]
    if "Twist" in robots[0]["commands"]["type"]:
        pairs = [(line, robot["place"]) for line, robot in zip(lines, robots, strict=True)]
        legend = Text("the plane as the ground sees it: ", palette.DIM)
        for robot, colour in zip(robots, COLOURS, strict=False):
            legend.append(f"{robot['robot']} ", colour)
        return [*draw_tracks(pairs, min(width, _PICTURE[0]), _PICTURE[1]), one_line(legend)]
    return joints([(robot["robot"], robot["place"]) for robot in robots])


def _way(row: Mapping[str, Any]) -> Text:
    return plain(f"{row['from'] or 'the robot'} → {row['to'] or 'the robot'}")


def _lost(row: Mapping[str, Any]) -> Text:
    return count_cell(sum(row["lost"].values()) + row["refused"], Level.ERROR.style)


def _arrived(row: Mapping[str, Any]) -> Text:
    return Text(words.count(row["arrived"] + row["of_others"]), palette.STRONG)


def _hertz(value: float | None) -> Text:
    return Text(words.rate(value).removesuffix(" Hz"), "" if value else palette.DIM)


def _latency(name: str, percent: str) -> Any:
    return lambda row: Text(
        words.milliseconds(None if row[name][percent] is None else row[name][percent] / 1000)
    )


_COLUMNS: Final = (
    Column("", lambda row: Text(row["leg"], palette.DIM), justify="left", rank=3),
    Column("Topic", _way, justify="left", elastic=True),
    Column("Said", figure("said")),
    Column("in Hz", lambda row: _hertz(row["in"]), rank=1),
    Column("Held", figure("held"), rank=2),
    Column("Lost", _lost),
    Column("Replaced", figure("replaced"), rank=2),
    Column("Arrived", _arrived),
    Column("out Hz", lambda row: _hertz(row["out"]), rank=1),
    Column("p50", _latency("latency_us", "p50"), rank=1),
    Column("p99", _latency("latency_us", "p99"), rank=2),
    Column("added p50", _latency("added_us", "p50"), rank=1),
    Column("p99 ", _latency("added_us", "p99"), rank=1),
)
"""``added`` is the time outside cFS."""


_ROWS: Final = 6
_PANELS: Final = 3
"""Places that are drawn: those with most losses."""


def _between(low: float, high: float) -> str:
    return f"{low:,.0f}" if low == high else f"{low:,.0f} to {high:,.0f}"


_PROOF_COLUMNS: Final = (
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
        parts.append(build(_PROOF_COLUMNS, [row.as_json() for row in proof.rows], width))
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
