"""CI or an application was stopped or restarted: what was sent to it meanwhile reached nobody."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edoras_tools.cfs.commands import ENABLE_OUTPUT
from edoras_tools.cfs.executive_services import STARTS
from edoras_tools.diagnosis.loss_verdict import loss_verdict, lost_at
from edoras_tools.diagnosis.verdict import Severity, Verdict

if TYPE_CHECKING:
    from collections.abc import Iterator

    from edoras_tools.diagnosis.case import Case

ID = "app_outage"
_KINDS = {"restart": "CI_LAB_APP was restarted", "stopped": "the application was stopped"}


def judge(case: Case) -> Iterator[Verdict]:
    """Name every outage, and what was lost in it."""
    told = []
    for loss in case.losses:
        if loss.kind in _KINDS:
            told.append(loss)
            yield loss_verdict(
                case,
                ID,
                loss,
                f"{lost_at(case, loss, 'commands')}: {_KINDS[loss.kind]}",
                link="ci" if loss.stream is None else loss.stream.link.label,
                remedy=_remedy(case, loss.hop),
            )
    for item in case.outages:
        end_ns = item.end_ns if item.end_ns is not None else case.end_ns
        if any(loss.hop == item.app and loss.start_ns <= end_ns + case.profile.ci_wake_ns for loss in told):
            continue
        back = (
            f"started again at {case.at(item.end_ns)}"
            if item.end_ns is not None
            else "not started again here"
        )
        yield Verdict(
            ID,
            Severity.WARNING,
            f"{item.app} was stopped at {case.at(item.start_ns)}, {back}; no loss by it can be seen here",
            hop=item.app,
            start_ns=item.start_ns,
            end_ns=end_ns,
            evidence=(f"event {item.said}",),
            remedy=f"enable it again after it restarts: {case.inject(ENABLE_OUTPUT)}"
            if item.app.startswith("TO_")
            else _remedy(case, item.app),
        )


def _remedy(case: Case, app: str | None) -> str:
    """Return what helps: to start it again where it still does not run."""
    last = next((item for item in reversed(case.outages) if item.app == app), None)
    if app not in STARTS or last is None or last.end_ns is not None:
        return "send nothing while an application is restarted"
    return f"start it again: {case.inject('es-start-app', app)}"
