"""An application's pipe was full: its task does not keep up with all that it subscribes to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.diagnosis.verdict import Severity, Verdict
from edoras_tools.sessions import telemetry_output

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "app_pipe_overflow"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId and the pipe."""
    for loss in case.losses:
        if loss.kind != "overflow" or loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN"):
            continue
        of = f" of {loss.of:,}" if loss.of else ""
        yield Verdict(
            ID,
            Severity.ERROR,
            f"{loss.lost:,}{of} messages on {case.name(loss.msg_id)} lost at {loss.hop}: the pipe was full",
            msg_id=loss.msg_id,
            topic=case.topic(loss.msg_id),
            link=loss.stream.link.label if loss.stream else None,
            hop=loss.hop,
            lost=loss.lost,
            of=loss.of,
            start_ns=loss.start_ns,
            end_ns=loss.end_ns,
            evidence=(*loss.evidence, *case.drops_text()),
            remedy="send less of everything that this pipe takes, make it deeper (CFE_SB_CreatePipe), or "
            "have its task run more often",
            confidence=loss.confidence,
        )
