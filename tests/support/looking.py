"""What an eye would see in a picture or page, as figures: boxes of labels, colours, contrast."""

from __future__ import annotations

import re
from functools import cache
from itertools import combinations
from typing import NamedTuple
from xml.etree import ElementTree as ET

_RULE = re.compile(r"([^{}]+)\{([^{}]*)\}")
_VARIABLE = re.compile(r"--([\w-]+): *(#[0-9a-f]{3,6})")


class Label(NamedTuple):
    """A text of a picture and its box, in units of the view box; as wide as in the usual fonts at most."""

    text: str
    left: float
    top: float
    right: float
    bottom: float

    def covers(self, other):
        """Tell whether two labels overlap by more than a hair."""
        return (
            min(self.right, other.right) - max(self.left, other.left) > 1
            and min(self.bottom, other.bottom) - max(self.top, other.top) > 1
        )


def svgs(page):
    """Return the charts of a page, parsed."""
    return [
        ET.fromstring(text.replace("&nbsp;", " ")) for text in re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    ]


def labels(svg, size):
    """Return the labels of a picture whose letters have a size, unless they say another."""
    found = []
    for item in svg.iter():
        if item.tag.rpartition("}")[2] != "text":
            continue
        letters, classes = float(item.get("font-size", size)), item.get("class", "").split()
        text = "".join(item.itertext())
        wide = letters * sum(
            0.9 if sign in "MWmw@%" else 0.32 if sign in "iljtfrI.,:;'|!()[]/ " else 0.6 for sign in text
        )
        anchor = item.get("text-anchor") or (
            "end" if "end" in classes else "middle" if "mid" in classes else "start"
        )
        left = float(item.get("x")) - {"start": 0.0, "middle": wide / 2, "end": wide}[anchor]
        base = float(item.get("y", 0))
        found.append(Label(text, left, base - 0.75 * letters, left + wide, base + 0.2 * letters))
    return found


def overlaps(found):
    """Return the pairs of labels that cover each other."""
    return [(one.text, other.text) for one, other in combinations(found, 2) if one.covers(other)]


def themes(style):
    """Return the variables of a style sheet in the light and in the dark look."""
    light = dict(_VARIABLE.findall(style.partition("@media (prefers-color-scheme")[0]))
    dark = dict(_VARIABLE.findall(style.partition("@media (prefers-color-scheme")[2].partition("\n}")[0]))
    return light, light | dark


def rgb(text):
    """Return a colour as red, green and blue."""
    text = text.lstrip("#")
    text = "".join(2 * sign for sign in text) if len(text) == 3 else text
    return [int(text[at : at + 2], 16) for at in (0, 2, 4)]


def contrast(ground, ink):
    """Return the contrast of two colours (red, green and blue to 255) as WCAG 2.2 defines it: 1 to 21."""
    low, high = sorted(map(_luminance, (ground, ink)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour):
    parts = [part / 255 for part in colour]
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@cache
def paint_of(style, classes):
    """Return the variable that a shape of these classes is filled or drawn with; None: with none of ours."""
    best = None
    for selectors, body in _RULE.findall(style.partition("@media (max-width")[0]):
        found = re.search(r"(?<![\w-])(?:fill|stroke): var\(--([\w-]+)\)", body)
        for selector in selectors.split(","):
            names = re.findall(r"\.([\w-]+)", selector)
            if found and names and selector.strip().startswith("svg ") and {*names} <= {*classes.split()}:
                best = max(best or (0, ""), (len(names), found[1]), key=lambda item: item[0])
    return best and best[1]
