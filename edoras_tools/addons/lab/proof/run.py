"""Reads a capture twice: judges it, then the part around its worst loss, and runs the model on that part."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from msgspec.structs import replace

from edoras_tools.addons.lab.proof.model import BEFORE_NS, CaptureProof, Stimulus, prove, window
from edoras_tools.cfs import telemetry_output
from edoras_tools.links.table import among
from edoras_tools.pipelines.doctor.doctor import examine
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.selection import Period

if TYPE_CHECKING:
    from collections.abc import Callable

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.examination import Diagnosis
    from edoras_tools.io import Source
    from edoras_tools.pipelines.workbench import Workbench

    OpenInput = Callable[[], tuple[Source, Workbench]]


def prove_capture(opened: OpenInput) -> tuple[Diagnosis, CaptureProof]:
    """Judge a capture and prove it; return the diagnosis of the whole capture, and the proof.

    Args:
        opened: function that opens the same input again.

    Raises:
        CaptureError: the capture cannot be read.
    """
    source, bench = opened()
    whole = examine(source, bench)
    if whole.failure is not None:
        raise whole.failure
    every = whole.diagnosis
    span = window(every)
    part = every
    if span != (every.start_ns, every.end_ns):
        start_ns = span[0] - every.zero_ns
        period = Period(start_ns=start_ns, end_ns=start_ns + span[1] - span[0])
        source, bench = opened()
        part = examine(source, bench, scope=Scope(period=period)).diagnosis
    case = part.case
    if case is None or not part.datagrams:
        return every, CaptureProof((0.0, 0.0), not_modelled="nothing of cFS was examined")
    if part is not every:
        part = replace(part, capture=replace(part.capture, zero_ns=every.zero_ns))
    return every, prove(part, case, _stimuli(opened, case, span), span)


def _stimuli(opened: OpenInput, case: Case, span: tuple[int, int]) -> list[Stimulus]:
    """Return datagrams into cFS: from ``BEFORE_NS`` before a span to its end, and earlier ones that last."""
    source, bench = opened()
    stimuli: list[Stimulus] = []
    lasting: dict[bytes, Stimulus] = {}
    begin_ns = span[0] - BEFORE_NS
    inbound = [item for item in case.streams if item.link.peers and not item.counted]
    ports = [case.endpoints[item.receiver].port for item in inbound]
    streams = [item.rows for item in case.streams if item.link.only_to_cfs]
    commands = case.rows.number[np.concatenate([np.zeros(0, np.intp), *streams])]
    with reading(source, bench) as loop:
        for rows in loop:
            batch, columns = rows.batch, rows.columns
            to_ci = among(columns.link, lambda link: link.only_to_cfs)
            over = among(columns.link, lambda link: link.peers) & np.isin(batch.destination_port, ports)
            is_early = batch.time_ns < begin_ns
            lasts = (columns.msg_id == telemetry_output.COMMAND_MSG_ID) | (over & (columns.msg_id < 0))
            # Datagrams captured twice, or in front of a relay, are in no stream.
            judged = over | (batch.time_ns < span[0]) | np.isin(batch.number, commands)
            inside = (lasts | ~is_early) & judged & (batch.time_ns <= span[1])
            for row in np.flatnonzero((to_ci | over) & inside).tolist():
                when, msg_id = max(int(batch.time_ns[row]), begin_ns), int(columns.msg_id[row])
                item = Stimulus(when, bool(over[row]), msg_id, bytes(batch[row].payload))
                if is_early[row]:
                    lasting.pop(item.payload, None)  # keep the last of equal ones, at its place
                    lasting[item.payload] = item
                else:
                    stimuli.append(item)
    return [*lasting.values(), *sorted(stimuli, key=lambda item: item.time_ns)]
