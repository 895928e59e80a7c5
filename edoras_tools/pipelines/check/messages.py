"""Reads what is held against expectations, and says of what they cannot be.

Rates, counts, sizes, silences and fields are seen in messages. Losses, latencies, events, findings and
verdicts are seen in datagrams alone: a recording without them is counted, and not judged.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.pipelines.doctor.doctor import Findings, Pace, examine
from edoras_tools.pipelines.doctor.scope import Scope
from edoras_tools.pipelines.reading import reading

if TYPE_CHECKING:
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.errors import EdorasError
    from edoras_tools.io import Source
    from edoras_tools.pipelines.capture.info import Counting
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.render.terminal.run import Progress

NOT_OBSERVABLE: Final = "not observable in this recording: it has messages and no datagrams"
"""Found of an expectation that needs datagrams; it is not met."""


@dataclass(slots=True)
class CountedMessages:
    """How the counting of messages ended; as ``doctor.Findings`` where these can say the same.

    Attributes:
        source: the recording.
        zero_ns: time of its first message.
        failure: why it ended early, if it did.
        warnings: a line each.
        unnamed: nothing: a recording has no ports.
        diagnosis: none.
    """

    source: Source
    zero_ns: int = 0
    failure: EdorasError | None = None
    warnings: list[str] = field(default_factory=list)
    unnamed: tuple[str, ...] = ()
    diagnosis: None = None


Examined = Findings | CountedMessages


def examine_or_count(
    source: Source,
    bench: Workbench,
    counting: Counting,
    *,
    profile: SimProfile | None = None,
    scope: Scope | None = None,
    pace: Pace | None = None,
    progress: Progress | None = None,
) -> Examined:
    """Read a source to its end, as ``examine`` does; the messages of a recording are only counted.

    Raises:
        RouteError: the selection names no topic.
        ConfigError: its filter has an error, or it selects datagrams of a recording.
    """
    if not bench.mission.recorded:
        return examine(
            source, bench, profile=profile, scope=scope, pace=pace, progress=progress, counting=counting
        )
    scope = scope or Scope()
    with reading(source, bench, scope.selection, examined=scope.period, keeps_failure=True) as loop:
        for rows in loop:
            if progress is not None:
                progress.read(source)
            counting.add(rows, loop)
    ledger = counting.report.ledger
    warnings = [*bench.columns.context.notes, *ledger.notes, *ledger.unread]
    return CountedMessages(source, loop.begin_ns or 0, loop.failure, warnings)
