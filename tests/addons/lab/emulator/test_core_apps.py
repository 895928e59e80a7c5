"""Every event of cFE's own applications: what its text writes, its pattern reads."""

from __future__ import annotations

from string import Formatter

import pytest

from edoras_tools.addons.lab.emulator.core_apps import CORE

EVENTS = [event for app in CORE for event in (app.initialized, app.no_op, app.bad_length) if event]


@pytest.mark.parametrize("event", EVENTS, ids=lambda item: f"{item.app} {item.event_id}")
def test_a_pattern_reads_what_the_text_writes(event):
    fields = [(name, form or "") for _, name, form, _ in Formatter().parse(event.text) if name]
    values = {name: 0x1827 + at if form else f"APP_{at}" for at, (name, form) in enumerate(fields)}
    found = event.pattern.fullmatch(event.text.format(**values))
    bases = {name: 10 if form.endswith("d") else 16 for name, form in fields if form}
    assert values == {
        name: int(text, bases[name]) if name in bases else text for name, text in found.groupdict().items()
    }
    assert len(event.phrase) > 5
