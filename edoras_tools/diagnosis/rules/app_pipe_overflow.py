"""An application's pipe was full: its task does not keep up with all that it subscribes to."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs import telemetry_output
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case
    from edoras_tools.diagnosis.verdict import Verdict

ID = "app_pipe_overflow"


def judge(case: Case) -> Iterator[Verdict]:
    """Name the MsgId and the pipe."""
    for loss in case.losses:
        if loss.kind != "overflow" or loss.hop == telemetry_output.PIPE or loss.hop.startswith("SBN"):
            continue
        yield loss_verdict(
            case,
            ID,
            loss,
            f"{lost_at(case, loss)}: the pipe was full",
            link=loss.stream.link.label if loss.stream else None,
            remedy="send less of everything that this pipe takes, make it deeper (CFE_SB_CreatePipe), or "
            "have its task run more often",
        )
