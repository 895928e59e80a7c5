"""How many of the datagrams that were sent Command Ingest has read, by its own count in 0x884.

Rules:

1. CI counts every datagram that it reads, good or bad. Its count before the first datagram is what later
   counts are compared with.
2. It is known exactly where a count came before anything was sent here, or where it stood still after what
   was sent to enable telemetry: then nothing of it is under way.
3. A count that stood still for three reports after the last datagram grows no more: CI reads its socket at
   least twice a second, and reports each 1 to 4 s. What it has not counted by then never came to it.
4. A count that falls was reset, or CI began anew: it tells nothing any more.
5. A count that grew by more than was sent here contains what others sent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

_STANDS_STILL: Final = 2
"""Reports that repeat the one before them."""


@dataclass(slots=True)
class IngestCount:
    """Compares CI's count with what was sent to it.

    Attributes:
        sent: datagrams sent to CI so far; kept up to date by whoever sends.
        reports: how often CI has reported its count.
    """

    sent: int = 0
    reports: int = 0
    _base: tuple[int, int] | None = None
    _exact: bool = False
    _begun: bool = False
    _last: tuple[int, int] | None = None
    _repeated: int = 0
    _anew: bool = False

    def reported(self, count: int) -> None:
        """Take a report.

        Args:
            count: datagrams that CI has read, since it began.
        """
        now = count, self.sent
        self.reports += 1
        if self._last is not None and count < self._last[0]:
            self._anew = self._begun
            self._base = self._last = None
        self._repeated = self._repeated + 1 if now == self._last else 0
        self._last = now
        if not self._begun or self._base is None:
            self._base = now
            self._exact = not self._anew and (not self.sent or (not self._begun and self._repeated > 0))

    def begin(self) -> None:
        """Note that from now on what is to be counted is sent."""
        self._begun = True

    @property
    def is_known(self) -> bool:
        """Whether the count before the first datagram is known exactly."""
        return self._exact

    @property
    def is_final(self) -> bool:
        """Whether the count grows no more, or shows that CI has read everything."""
        return self._repeated >= _STANDS_STILL or (self.is_counted and self.read >= self.expected)

    @property
    def expected(self) -> int:
        """Datagrams that were sent since the count is known."""
        return self.sent - (self._base[1] if self._base and self._exact else 0)

    @property
    def read(self) -> int:
        """Datagrams that CI has certainly read since then, others' included."""
        return self._last[0] - self._base[0] if self._last and self._base else 0

    @property
    def missing(self) -> int:
        """Datagrams that certainly never came to CI."""
        return max(0, self.expected - self.read) if self._exact and self.is_final else 0

    @property
    def is_counted(self) -> bool:
        """Whether CI has reported since the first datagram was sent."""
        return self._begun and self._last is not None and self._last[1] > 0

    def summary(self) -> dict[str, Any]:
        """Return ``ingest`` of ``replay --json``."""
        if self._anew:
            state = "restarted"
        elif not self.is_counted:
            state = "unknown"
        elif self.read > self.expected:
            state = "others"
        elif self.read == self.expected:
            state = "all"
        elif not self._exact:
            state = "partly" if self.read else "unknown"
        else:
            state = "missing" if self.is_final else "waiting"
        told = state in {"all", "missing", "waiting", "partly"}
        return {
            "state": state,
            "sent": self.expected,
            "read": self.read if told else None,
            "missing": self.missing if state in {"all", "missing"} else None,
        }
