"""Colours that are read on light and on dark, everywhere in the package."""

import re

from places import ROOT

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
