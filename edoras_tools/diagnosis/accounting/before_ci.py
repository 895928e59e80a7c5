"""What was lost before CI, or may wait in its socket, shared out to the messages that were sent to it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.diagnosis.accounting.claims import shares
from edoras_tools.diagnosis.accounting.fates import LOST_AT, Fate, loss_of
from edoras_tools.diagnosis.accounting.losses import Known, Loss

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from edoras_tools.diagnosis.accounting.ingest import Before, Ingest


_OUTAGES: Final = frozenset({"down", "restart"})


class BeforeCi:
    """Shares out the accounts of CI.

    Args:
        fates: what became of messages, as far as it is told.
    """

    def __init__(self, known: Known, fates: Sequence[Fate], losses: list[Loss]) -> None:
        self._known, self._fates, self.losses = known, fates, losses
        self._told: dict[int, int] = {}

    def share(self, account: Ingest) -> None:
        """Share out all that was lost before a CI."""
        for before in account.losses:
            self._before_ci(account, before)
        self._begins_amid(account)

    def wait(self, account: Ingest) -> None:
        """Share out what waits in a CI's socket at its last count, once all else is told."""
        self._queue(account, account.waiting - self._more_before_ci(account))

    def _begins_amid(self, account: Ingest) -> None:
        """Tell as not captured what may have been lost too, where the capture begins amid datagrams."""
        fates = self._to(account)
        most = [int(fate.open.sum()) for fate in fates]
        for fate, share in zip(fates, shares(account.unsure, most, most), strict=True):
            fate.unsure = fate.claim(np.flatnonzero(fate.open)[:share])

    def _to(self, account: Ingest) -> list[Fate]:
        """Return what became of the streams that went to a CI."""
        return [
            fate
            for fate in self._fates
            if fate.stream.link.only_to_cfs and fate.stream.receiver == account.endpoint
        ]

    def _before_ci(self, account: Ingest, before: Before) -> None:
        """Share out what was lost before CI: to what did not come out, else by how much was sent."""
        left, fates = before.lost, self._to(account)
        if before.cause == "network" and left > self._missing(account, fates, before.end_ns):
            return  # more than did not come out: its counts are late, as over a slow link, and tell no loss
        evidence = self._before_evidence(account, before)
        if before.cause in _OUTAGES and (unheard := self._unheard(before, fates)):
            left += unheard
            self._told[id(before)] = unheard
            evidence.append(f"{unheard:,} more did not come out, and its counts leave room for them")
        if before.said:
            for fate in fates:  # nor will it come
                never = fate.waits & (self._known.captured(fate.stream) > before.since_ns)
                fate.open |= never
                fate.waits &= ~never
        # What did not come out is the likelier; what is lost first may have been before the first count.
        seen = [fate for fate in fates if fate.seen]
        spans = [(seen, before.since_ns), (fates, before.since_ns), (fates, 0)][: 2 if before.said else None]
        if before is account.losses[0] and not before.said:
            spans.insert(1, (seen, 0))
        for those, since_ns in spans:
            left -= self._spread(those, before, since_ns, left, evidence)
        if left and before.cause != "unknown":
            self._nobodys(before, left, evidence)

    def _unheard(self, before: Before, fates: Sequence[Fate]) -> int:
        """Return how many more did not come out of a CI that was away, and have room in its counts."""
        missing = sum(
            int((fate.open & (times > before.since_ns) & (times <= before.end_ns)).sum())
            for fate in fates
            if fate.seen and len(times := self._known.captured(fate.stream))
        )
        return max(0, min(before.more, missing - before.lost))

    def _missing(self, account: Ingest, fates: Sequence[Fate], end_ns: int) -> int:
        """Return the most that can be lost of what was sent to a CI until a time: what did not come out."""
        times = self._known.rows.time_ns[account.rows]
        missing = int(np.searchsorted(times, end_ns, "right"))
        for fate in fates:
            missing -= int((~fate.open & (self._known.captured(fate.stream) <= end_ns)).sum())
        return missing

    def _spread(
        self, fates: Sequence[Fate], before: Before, since_ns: int, number: int, evidence: list[str]
    ) -> int:
        """Tell up to so many messages of some streams lost before CI; return how many were."""
        window: list[tuple[Fate, NDArray[np.intp]]] = []
        for fate in fates:
            times = self._known.captured(fate.stream)
            inside = np.flatnonzero((times > since_ns) & (times <= before.end_ns) & fate.open)
            if len(inside):
                window.append((fate, inside))
        most = [len(inside) for _, inside in window]
        parts = shares(number, most, most)
        for (fate, inside), share in zip(window, parts, strict=True):
            if share:
                # Behind the last one that came out there is no newer one that they could have given way to.
                last = int(np.flatnonzero(fate.arrived)[-1]) if fate.arrived.any() else inside[-1]
                sure = inside[inside > last][:share]
                others = np.setdiff1d(inside, sure)
                spread = np.linspace(0, len(others) - 1, share - len(sure)).round().astype(np.intp)
                chosen = np.union1d(sure, others[spread])
                fate.claim(chosen)
                if before.cause == "unknown":
                    fate.uncounted += share
                    continue
                self.losses.append(loss_of(self._known, fate, before.cause, chosen, evidence, among=inside))
        return sum(parts)

    def _more_before_ci(self, account: Ingest) -> int:
        """Tell lost, in CI's last span of loss, what did not come out and its counts leave room for."""
        if not account.more:
            return 0
        last = [item for item in account.losses if item.cause != "ci_stopped"][-1]
        if last.cause in _OUTAGES:
            return self._told.get(id(last), 0)
        seen = [fate for fate in self._to(account) if fate.seen]
        evidence = ["they did not come out, later ones did, and CI's counts leave room for them"]
        # What is lost first may have been before the first count.
        since_ns = last.since_ns if len(account.losses) > 1 else 0
        return self._spread(seen, last, since_ns, account.more, evidence)

    def _queue(self, account: Ingest, number: int) -> None:
        """Tell which messages may wait in CI's socket at its last count: the latest of those that may.

        CI reads in order: what was sent before one that came out does not wait.
        """
        rows = self._known.rows
        free, read_ns = np.ones(len(rows), bool), -1
        for fate in self._to(account):
            free[fate.stream.rows] = fate.open | fate.waits
            if fate.arrived.any():
                read_ns = max(read_ns, int(self._known.captured(fate.stream)[fate.arrived].max()))
        times = rows.time_ns[account.rows]
        own = account.rows[(times > read_ns) & (times <= account.last_ns) & free[account.rows]]
        late = own[len(own) - min(number, len(own)) :]
        for fate in self._to(account):
            if not fate.seen:
                behind = self._known.captured(fate.stream) > account.last_ns
                fate.late = int(behind.sum())
                fate.open &= ~behind
            chosen = np.isin(fate.stream.rows, late)
            fate.queued += int(chosen.sum())
            fate.open &= ~chosen
            fate.waits &= ~chosen

    def _nobodys(self, before: Before, number: int, evidence: list[str]) -> None:
        """Tell of datagrams that CI did not count and that are of no stream, as those without a MsgId."""
        self.losses.append(
            Loss(
                kind=before.cause,
                hop=LOST_AT[before.cause],
                lost=number,
                start_ns=before.start_ns,
                end_ns=before.end_ns,
                confidence="medium",
                evidence=evidence,
            )
        )

    def _before_evidence(self, account: Ingest, before: Before) -> list[str]:
        if before.said:
            return [before.said]
        taken = account.taken
        if account.by_kernel:
            of = f"{before.lost:,} of {len(account.rows):,} datagrams"
            return [f"/edoras/host: {of} dropped in its socket (the kernel's counter)"]
        text = f"0x884: CI took {taken:,} of {taken + account.lost + account.waiting:,} datagrams sent to it"
        evidence = [text, f"{before.lost:,} of them lost between two of its counts"]
        if account.unsure:
            evidence.append(
                "the capture begins amid commands, of which its first counts may have some or not: up to "
                f"{account.unsure:,} more may be lost, told as not captured"
            )
        return evidence
