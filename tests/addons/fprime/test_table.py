"""The texts of F Prime's events: the forms that FPP allows, filled as the ground system fills them."""

from __future__ import annotations

import pytest

from edoras_tools.addons.fprime.link import PacketType
from edoras_tools.addons.fprime.table import Entry, EventSeverity

TEXTS = {
    "none": ("Stuck", [], "Stuck"),
    "plain": ("{} to {}", [5, 3], "5 to 3"),
    "hexadecimal": ("0x{x}, {X}", [255, 255], "0xff, FF"),
    "digits": ("{.2f} {e} {8.3f}|", [1.005, 0.5, 2.0], "1.00 5.000000e-01    2.000|"),
    "a letter": ("{c}{d}{o}", [65, 7, 8], "A710"),
    "braces": ("{{{}}} {{}}", [1], "{1} {}"),
    "too few": ("{} {} {}", [1], "1 {} {}"),
    "too many": ("{}", [1, 2], "1"),
    "a form that does not fit": ("{x} {.2f}", ["a", [1]], "a [1]"),
    "no form of FPP": ("{0.__class__} {!r} {:>9}", [1], "{0.__class__} {!r} {:>9}"),
    "a width that is too much": ("{9999999999d}", [1], "{9999999999d}"),
    "a letter that there is not": ("{c}", [1 << 40], "1099511627776"),
    "no format": ("", [1, 2], "1 2"),
}


@pytest.mark.parametrize("what", TEXTS)
def test_the_text_of_an_event(what):
    form, values, told = TEXTS[what]
    entry = Entry(PacketType.EVENT, 1, "Ref.a.B", EventSeverity.COMMAND, form)
    assert entry.event_text(values, list(map(str, values))) == told


def test_what_an_entry_is_called():
    entry = Entry(PacketType.PACKETIZED_TELEMETRY, 2, "Motion")
    assert (entry.word, entry.topic, entry.id_text) == ("packet", "/fprime/packets/Motion", "0x0002")
    entry = Entry(PacketType.TELEMETRY, 2, "Ref.a.B")
    assert (entry.word, entry.topic, entry.id_text) == ("channel", "/fprime/channels/Ref/a/B", "0x00000002")
    assert {item.level for item in EventSeverity} == {10, 20, 30, 40, 50}
    assert EventSeverity.of("FATAL") is EventSeverity.FATAL
    assert EventSeverity.of(["FATAL"]) is None
