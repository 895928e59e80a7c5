"""Colours that are read on light and on dark, everywhere in the package."""

import os
import re
import subprocess
import sys
from functools import cache

import pytest
from places import ROOT
from rich.color import Color

from edoras_tools.render.terminal import palette


def test_no_style_is_unreadable_on_light_or_on_dark():
    wrong = re.compile(r"""["](?:\w+ )*(?:bright_(?!blue)\w+|blue|white|black|gr[ea]y\d*)["]""")
    found = [
        f"{path.name}: {line.strip()}"
        for folder in ("render", "tui", "links", "cli")
        for path in (ROOT / "edoras_tools" / folder).rglob("*.py")
        if path.name not in {"svg.py", "page.py"}
        for line in path.read_text().splitlines()
        if wrong.search(line)
    ]
    assert found == []


def test_layers_of_one_protocol_share_their_style():
    assert palette.layer("cfe_event") == palette.layer("cfe_command") == palette.layer("cfe")
    assert palette.layer("udp") == palette.DIM
    assert len({palette.layer(name) for name in ("sbn", "ccsds", "cfe", "edoras", "cdr", "ros")}) == 6


@pytest.mark.parametrize(
    "names",
    [
        ("sbn", "ccsds", "cfe_command", "edoras", "cdr", "ros"),
        ("ccsds", "cfe_telemetry", "cfe_event"),
        ("fprime_tm", "fprime_space_packet", "fprime_packet", "fprime_event", "fprime_channel", "cfs"),
    ],
)
def test_each_layer_of_a_packet_has_its_colour(names):
    styles = palette.layers(["udp", *names, *names])
    assert [*styles] == ["udp", *names]
    assert len({*styles.values()}) == 1 + len(names)
    assert styles["udp"] == palette.DIM


def luminance(colour):
    parts = [part / 255 for part in colour]
    linear = [part / 12.92 if part <= 0.03928 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@cache
def shades(term):
    """Return what stands for names of colours in a terminal, and how one of them is written."""
    code = "from edoras_tools.render.terminal import palette as p; print(p.SHADES, p.escapes('bold yellow'))"
    environment = {name: value for name, value in os.environ.items() if name != "COLORTERM"} | {"TERM": term}
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**environment, "TERM": term}
    )
    return done.stdout.strip()


def test_sixteen_colours_have_their_names():
    assert shades("xterm") == r"{} ('\x1b[1;33m', '\x1b[0m')"


def test_bold_text_has_the_shade_too():
    """A headline is ``green bold``: rich's own green vanishes on white."""
    code = "from edoras_tools.render.terminal.palette import output_console as console; "
    code += (
        "print([console().get_style(f'{name} bold').color.number for name in ('green', 'yellow', 'cyan')])"
    )
    environment = {**os.environ, "TERM": "xterm-256color"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment
    )
    assert done.stdout == "[64, 136, 30]\n"


GROUNDS = {"white": (255, 255, 255), "black": (0, 0, 0), "dark": (0, 43, 54), "light": (253, 246, 227)}


@pytest.mark.parametrize("ground", GROUNDS)
def test_shades_are_read_on_every_ground(ground):
    text = shades("xterm-256color")
    assert text.endswith(r"('\x1b[1;38;5;136m', '\x1b[0m')")
    for name in re.findall(r"color\(\d+\)", text):
        first, second = sorted(
            (luminance(Color.parse(name).get_truecolor()), luminance(GROUNDS[ground])), reverse=True
        )
        assert (first + 0.05) / (second + 0.05) >= 3
