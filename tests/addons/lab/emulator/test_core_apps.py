"""Every event of cFE's own applications: what its text writes, its pattern reads."""

from __future__ import annotations

from string import Formatter

import pytest

from edoras_tools.addons.lab.emulator import Simulation
from edoras_tools.addons.lab.emulator.core_apps import CORE
from edoras_tools.units import SECOND
from edoras_tools.wire import cfe

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


def test_what_answers_by_an_event_does_so_here():
    run = Simulation(scenario="rover", bridges=False, start_ns=0).boot()
    start_s = run.now // SECOND
    sent = [
        (0x1827, 0, b""),
        (0x1806, 1, b""),
        (0x1801, 9, b"CFE_SB"),
        (0x1801, 9, b"CFE_SB".ljust(20, b"\0")),
    ]
    for at, (msg_id, code, payload) in enumerate(sent, 1):
        packet = cfe.emit_command(msg_id, code, payload)
        run.feed((start_s + at) * SECOND, run.cfs.ci_endpoint, packet)
    before = len(run.cfs.console)
    list(run.run((start_s + 8) * SECOND))
    said = [text.partition("66/1/")[2] for _, text in list(run.cfs.console)[before:]]
    assert said == [
        "EDORAS_APP 3: Edoras App: NOOP command Emulated",
        "CFE_ES 4: Reset Counters command",
        "CFE_EVS 43: Invalid msg length: ID = 0x1801,  CC = 9, Len = 14, Expected = 28",
    ]
