"""XML with one mistake."""

from __future__ import annotations

import re

WRONG = (b"", b"-1", b"0", b"99999999999", b"${X/Y}", b"2 ^ 99", b"a/b/c", b"1.5", b"((((", b"\xc3\xa9")


def damaged(data, draw):
    """Return a file with one mistake: cut, bytes, lines, a value or a name of an element."""
    kind, lines = draw.randrange(6), data.split(b"\n")
    if kind == 0:
        return data[: draw.randrange(len(data))]
    if kind == 1:
        at = draw.randrange(len(data))
        return data[:at] + bytes([draw.randrange(256)]) + data[at + 1 :]
    if kind == 2:
        at = draw.randrange(len(lines))
        return b"\n".join(lines[:at] + lines[at + draw.randrange(1, 6) :])
    words = list(re.finditer(rb"<(\w+)" if kind == 3 else rb'="([^"]*)"', data))
    one, other = draw.choice(words), draw.choice(words)[1]
    return data[: one.start(1)] + (draw.choice(WRONG) if kind == 4 else other) + data[one.end(1) :]
