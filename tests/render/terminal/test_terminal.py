from __future__ import annotations

import io

import pytest

from edoras_tools.render.terminal import palette as console
from edoras_tools.render.terminal.palette import FILE_WIDTH, Terminal, detect_terminal


class Tty(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize(
    ("stream", "environ", "colour", "interactive"),
    [
        (Tty, {}, True, True),
        (Tty, {"NO_COLOR": "1"}, False, True),
        (Tty, {"NO_COLOR": ""}, True, True),
        (Tty, {"NO_COLOR": "1", "FORCE_COLOR": "1"}, False, True),
        (Tty, {"TERM": "dumb"}, False, False),
        (io.StringIO, {}, False, False),
        (io.StringIO, {"FORCE_COLOR": "1"}, True, False),
    ],
)
def test_colour_and_redrawing(stream, environ, colour, interactive):
    terminal = detect_terminal(stream(), environ)
    assert (terminal.colour, terminal.interactive) == (colour, interactive)


@pytest.mark.parametrize(
    ("stream", "environ", "width"),
    [
        (Tty, {}, 80),
        (Tty, {"COLUMNS": "132"}, 132),
        (Tty, {"COLUMNS": "wide"}, 80),
        (Tty, {"COLUMNS": "0"}, 80),
        (io.StringIO, {}, FILE_WIDTH),
        (io.StringIO, {"COLUMNS": "90"}, 90),
    ],
)
def test_width(stream, environ, width):
    assert detect_terminal(stream(), environ).width == width


@pytest.mark.parametrize("colour", [False, True])
def test_consoles_show_what_the_stream_can(monkeypatch, colour):
    out = io.StringIO()
    monkeypatch.setattr("sys.stdout", out)
    monkeypatch.setattr(console, "detect_terminal", lambda _: Terminal(33, colour, interactive=False))
    made = console.output_console()
    made.print("x" * 40 + " [red]1234[/red]", style="red")
    text = out.getvalue()
    assert ("\x1b[31m" in text) == colour
    assert "[red]1234[/red]" in text.replace("\n", "")
    assert made.width == 33
