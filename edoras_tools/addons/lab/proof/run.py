"""Reads a capture twice: judges it, and what is around its worst loss, and lets that go through the model."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.addons.lab.proof.model import BEFORE_NS, CaptureProof, Stimulus, prove, window
from edoras_tools.links.table import among
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.selection import Period

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench

    OpenInput = Callable[[], tuple[Source, Workbench]]


def prove_capture(opened: OpenInput, profile: SimProfile) -> tuple[Diagnosis, CaptureProof]:
    """Judge a capture and prove it; return what is said of all of it, and the proof.

    Args:
        opened: opens the same input anew.
        profile: constants of cFS that were given.

    Raises:
        CaptureError: it cannot be read.
    """
    source, bench = opened()
    whole = examine(source, bench, profile=profile)
    if whole.failure is not None:
        raise whole.failure
    every = whole.diagnosis
    span = window(every)
    part = every
    if span != (every.start_ns, every.end_ns):
        start_ns = span[0] - every.zero_ns
        period = Period(start_ns=start_ns, end_ns=start_ns + span[1] - span[0])
        source, bench = opened()
        part = examine(source, bench, profile=profile, scope=Scope(period=period)).diagnosis
    case = part.case
    if case is None or not part.datagrams:
        return every, CaptureProof((0.0, 0.0), not_modelled="nothing of cFS was examined")
    if part is not every:
        part = replace(part, capture=replace(part.capture, zero_ns=every.zero_ns))
    return every, prove(part, case, _stimuli(opened, case, span), span)


def _stimuli(opened: OpenInput, case: Case, span: tuple[int, int]) -> list[Stimulus]:
    """Return what went into cFS from a while before a span to its end."""
    source, bench = opened()
    stimuli: list[Stimulus] = []
    ports = {
        case.endpoints[item.receiver].port for item in case.streams if item.link.peers and not item.counted
    }
    with reading(source, bench) as loop:
        for rows in loop:
            batch, columns = rows.batch, rows.columns
            to_ci = among(columns.link, lambda link: link.only_to_cfs)
            over = among(columns.link, lambda link: link.peers) & np.isin(batch.destination_port, list(ports))
            inside = (batch.time_ns >= span[0] - BEFORE_NS) & (batch.time_ns <= span[1])
            for row in np.flatnonzero((to_ci | over) & inside).tolist():
                when, msg_id = int(batch.time_ns[row]), int(columns.msg_id[row])
                stimuli.append(Stimulus(when, bool(over[row]), msg_id, bytes(batch[row].payload)))
    return sorted(stimuli, key=lambda item: item.time_ns)
