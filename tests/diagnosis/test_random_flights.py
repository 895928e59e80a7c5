"""Random flights of the emulated cFS, and what the doctor says of them beside the emulator's own account."""

from __future__ import annotations

from effort import examples
from hypothesis import given, settings
from scenarios import flights, fly, truth
from truth import bounds, sums

from edoras_tools.addons.lab.emulator.source import frames_of
from edoras_tools.diagnosis.examination import Examination
from edoras_tools.io.frames.linklayer import Demux
from edoras_tools.pipelines.workbench import Settings

UNSURE = 0.05
"""Of what counters cover so much may be told as given way to a newer one: which of two nothing shows."""


def examined(sent):
    """Return what ``doctor --json`` says of some datagrams."""
    bench, demux = Settings(configs=[]).workbench(), Demux()
    examination = Examination(bench.columns.context)
    for first in range(0, len(sent), 1000):
        batch = demux.demux(frames_of(sent[first : first + 1000], first + 1))
        examination.add(batch, bench.columns.decode(batch))
    return examination.diagnose().as_json()


@settings(max_examples=examples(120))
@given(flights())
def test_what_is_proven_was_lost_and_what_counters_cover_is_told(flight):
    simulation, sent = fly(flight)
    result, (least, most) = examined(sent), truth(simulation, sent)
    assert sums(result) == []
    proven, more = bounds(result)
    assert proven <= most
    open_ = more + sum(result.get(name) or 0 for name in ("waiting", "not_captured"))
    assert least * (1 - UNSURE) <= proven + open_
