"""Draws the pictures of the pages from the sample captures, as the commands show them.

    python docs/make_pictures.py

``tests/docs`` draws them again and compares what they say.
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

import asyncio
import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rich.console import Console, RenderableType
from rich.text import Text
from textual.widgets import Input

from edoras_tools.addons.plot.series import open_recordings, parse_request, read_plot
from edoras_tools.addons.report.charts import sankey
from edoras_tools.addons.trace.views import standalone
from edoras_tools.addons.tui.viewer import Viewer, ViewOptions
from edoras_tools.decode.lines import line_of
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.sniff import decode_packet
from edoras_tools.pipelines.doctor import Scope, examine
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.render.capture import tree
from edoras_tools.render.capture.info import capture_summary
from edoras_tools.render.capture.packet_list import PacketList
from edoras_tools.render.doctor import screen
from edoras_tools.render.plot.svg import plot_svg
from edoras_tools.render.terminal import palette

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

SAMPLES: Final = Path(__file__).resolve().parents[1] / "samples"
FOLDER: Final = Path(__file__).parent / "pictures"
_ROVERS: Final = ("two_rovers_ground", "two_rovers_flight")
_CONFIGS: Final = " ".join(f"-c {name}.yaml" for name in _ROVERS)
_SHOWN: Final = (range(186, 196), range(1196, 1205), range(1345, 1351))
"""A link at work; a SUB that SBN refuses; a cut message that the app passes on."""
_FONTS: Final = re.compile(r"\s*@font-face \{.*?\}", re.DOTALL)


def without_fonts(svg: str) -> str:
    """Return a picture that rich made so that it loads nothing from elsewhere."""
    return _FONTS.sub("", svg)


def terminal_picture(views: Iterable[str | RenderableType], *, width: int, title: str) -> str:
    """Return an SVG of a terminal that shows views one below the other.

    It loads nothing from elsewhere and is the same for the same views.

    Args:
        views: lines with ANSI styles, or rich renderables.
        width: columns of the terminal; longer lines are cut.
        title: in the window's bar.
    """
    console = Console(
        record=True, width=width, file=io.StringIO(), force_terminal=True, color_system="standard"
    )
    for view in views:
        text = Text.from_ansi(view) if isinstance(view, str) else view
        console.print(text, no_wrap=isinstance(view, str), crop=True, highlight=False)
    return without_fonts(console.export_svg(title=title, unique_id="edoras"))


def _bench(capture: str, missions: Sequence[str]) -> tuple[Settings, Path]:
    configs = tuple(SAMPLES / f"missions/{name}.yaml" for name in missions)
    return Settings(configs), SAMPLES / f"captures/{capture}.pcap"


def sniff() -> str:
    """Draw the packet list."""
    settings, path = _bench("f_sbn_disconnect", _ROVERS)
    bench, source = settings.workbench(), open_files([path])
    view = PacketList(128, colour=True)
    lines = [view.header()]
    for batch in source.batches():
        for row in range(len(batch)):
            decoded = bench.dissector.dissect(batch[row])
            number, line = decoded.datagram.number, view.line(line_of(decoded))
            if any(number in part for part in _SHOWN):
                if lines[1:] and number in {part.start for part in _SHOWN}:
                    lines.append(palette.Paint(colour=True)("     ⋮", palette.DIM))
                lines.append(line)
    source.close()
    return terminal_picture(lines, width=128, title=f"edoras sniff -r f_sbn_disconnect.pcap {_CONFIGS}")


def decode() -> str:
    """Draw one packet, its tree and its bytes."""
    settings, path = _bench("f_sbn_disconnect", _ROVERS)
    decoded = decode_packet(open_files([path]), settings.workbench(), 189)
    lines = tree.packet_lines(decoded, 150, colour=True, highlight="ros.linear.x")
    title = f"edoras decode f_sbn_disconnect.pcap 189 {_CONFIGS} --layer ros.linear.x"
    return terminal_picture(lines, width=150, title=title)


def info() -> str:
    """Draw what is in a capture."""
    settings, path = _bench("a_rover", ["rover_ground"])
    summary = inspect(open_files([path]), settings.workbench()).summary()
    view = capture_summary({**summary, "source": path.name})
    return terminal_picture([view], width=100, title="edoras info a_rover.pcap -c rover_ground.yaml")


def doctor() -> str:
    """Draw the first screen of a diagnosis."""
    settings, path = _bench("d3_cpu1_cpu2", _ROVERS)
    source = open_files([path.with_suffix(".pcap.gz")])
    found = examine(source, settings.workbench()).diagnosis
    return terminal_picture([screen(found, 100)], width=100, title=f"edoras d3_cpu1_cpu2.pcap {_CONFIGS}")


def balance() -> str:
    """Draw the Sankey of a report."""
    settings, path = _bench("a_rover", ("rover_ground",))
    return standalone(sankey(examine(open_files([path]), settings.workbench()).diagnosis))


def _three_panes(
    size: tuple[int, int],
    *keys: str | int,
    capture: str = "f_sbn_disconnect",
    missions: Sequence[str] = _ROVERS,
    until: str = "",
) -> str:
    """Draw the three-pane view after some keys.

    Args:
        size: columns and lines.
        keys: ``<key>`` to be pressed, a text to be written, or a byte whose field is to be chosen.
        capture: whose packets.
        missions: that are named.
        until: a word that is there once all is shown.
    """
    settings, path = _bench(capture, missions)
    app = Viewer(open_files([path]), settings.workbench(), ViewOptions(Selection(), settings))
    app.title = " ".join(["edoras sniff --tui -r", path.name, *(f"-c {name}.yaml" for name in missions)])

    async def draw() -> str:
        async with app.run_test(size=size) as pilot:
            while app.reading:
                await pilot.pause(0.02)
            for key in keys:
                if isinstance(key, int):
                    app.layers.choose_byte(key)
                elif key.startswith("<"):
                    await pilot.press(key[1:-1])
                else:
                    while not isinstance(field := app.focused, Input):
                        await pilot.pause(0.02)
                    field.cursor_blink = False
                    field.insert_text_at_cursor(key)
                await app.workers.wait_for_complete()
                await pilot.pause(0.1)
            while app.store.settled < app.store.packets or until not in app.export_screenshot():
                await pilot.pause(0.02)
            before, after = "", without_fonts(app.export_screenshot())
            while before != after:
                await pilot.pause(0.5)
                before, after = after, without_fonts(app.export_screenshot())
            return after

    return asyncio.run(draw())


def tui() -> str:
    """Draw the three panes, a field chosen."""
    keys = ("<f>", "link == ci", "<enter>", "<colon>", "149", "<enter>", "<enter>", 28)
    return _three_panes((130, 42), *keys, capture="e_ci_errors", missions=["rover_ground"])


def tui_filter() -> str:
    """Draw what is wrong with a filter."""
    return _three_panes((100, 16), "<f>", "msg_id == 0x82a and liner.x > 0.1", "<enter>")


def tui_room() -> str:
    """Draw the control room."""
    judged = "1,763"  # datagrams of links
    return _three_panes((110, 44), "<d>", "<z>", capture="a_rover", missions=["rover_ground"], until=judged)


def tui_routes() -> str:
    """Draw the routes."""
    return _three_panes((110, 34), "<r>", "<j>", "<j>", "<enter>")


def tui_rates() -> str:
    """Draw the rates."""
    return _three_panes((110, 34), "<R>")


def tui_sequence() -> str:
    """Draw the conversation."""
    return _three_panes((110, 34), "<s>", *["<j>"] * 6, "<enter>")


def tui_small() -> str:
    """Draw the view on a small terminal."""
    return _three_panes((80, 24), "<colon>", "1197", "<enter>", "<enter>")


def plot() -> str:
    """Draw a plot of two fields."""
    settings, path = _bench("a_rover", ["rover_ground"])
    asked = [
        parse_request("/cmd_vel.linear.x,/cmd_vel.angular.z"),
        parse_request("/telemetry_pose.pose.position"),
    ]
    return plot_svg(read_plot(open_recordings([path], settings, Scope()), [path.name], asked, Scope()).figure)


PICTURES: Final[dict[str, Callable[[], str]]] = {
    "sniff": sniff,
    "decode": decode,
    "info": info,
    "doctor": doctor,
    "plot": plot,
    "balance": balance,
    "tui": tui,
    "tui_filter": tui_filter,
    "tui_room": tui_room,
    "tui_routes": tui_routes,
    "tui_rates": tui_rates,
    "tui_sequence": tui_sequence,
    "tui_small": tui_small,
}
"""What draws each ``pictures/NAME.svg``."""


def main() -> None:
    """Draw all of them."""
    FOLDER.mkdir(exist_ok=True)
    for name, draw in PICTURES.items():
        (FOLDER / f"{name}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
