"""Everything that the rules judge by, worked out once from what was recorded."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from edoras_tools.diagnosis.app_losses import app_losses
from edoras_tools.diagnosis.clocks import steadied
from edoras_tools.diagnosis.counters import Track, tracks
from edoras_tools.diagnosis.events import Culprit, Said, culprits
from edoras_tools.diagnosis.instances import NOBODY, Instances
from edoras_tools.diagnosis.losses import Known, Loss, telemetry_losses
from edoras_tools.diagnosis.matching import Hop, find_hops
from edoras_tools.diagnosis.peers import Network
from edoras_tools.diagnosis.streams import Stream, find_streams
from edoras_tools.model import NO_ROUTE, Link
from edoras_tools.sessions.profile import SECOND, SimProfile
from edoras_tools.wire.names import message_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from edoras_tools.decode import Context
    from edoras_tools.diagnosis.payloads import EventRecord, Payloads
    from edoras_tools.diagnosis.table import Recorder, Rows
    from edoras_tools.mission import Mission, Route
    from edoras_tools.model import Endpoint


@dataclass(frozen=True, slots=True)
class Capture:
    """What is known of the capture itself.

    Attributes:
        drops: frames that the kernel or a full queue lost before they were captured.
        warnings: what its source has to say.
    """

    drops: int = 0
    warnings: tuple[str, ...] = ()


class Case:
    """A capture, laid out for judgement.

    Attributes:
        rows: a row a datagram.
        jumps: clocks that were set meanwhile; times are as if they had not been.
        payloads: counters, events, subscriptions, TO commands.
        endpoints: what ``source`` and ``destination`` of the rows index.
        samples: (link, MsgId) to some CDR messages by length.
        context: mission, types and options.
        profile: the constants of cFS.
        capture: what is known of the capture itself.
    """

    def __init__(self, recorder: Recorder, profile: SimProfile, capture: Capture) -> None:
        rows, self.jumps = steadied(recorder.rows(), recorder.payloads.events)
        self.rows: Rows = rows
        self.payloads: Payloads = recorder.payloads.timed(rows.time_ns) if self.jumps else recorder.payloads
        self.endpoints: Sequence[Endpoint] = recorder.endpoints
        self.samples = recorder.samples
        self.context: Context = recorder.context
        self.profile = profile
        self.capture = capture

    @property
    def mission(self) -> Mission:
        """The mission; it may say nothing."""
        return self.context.mission

    @cached_property
    def start_ns(self) -> int:
        """The first datagram."""
        return int(self.rows.time_ns.min()) if len(self.rows) else 0

    @cached_property
    def end_ns(self) -> int:
        """The last datagram."""
        return int(self.rows.time_ns.max()) if len(self.rows) else 0

    @cached_property
    def instances(self) -> Instances:
        """The cFS instances."""
        return Instances(self.rows, self.payloads.events)

    @cached_property
    def streams(self) -> list[Stream]:
        """What was seen of each MsgId on each link."""
        return find_streams(self.rows, self.instances)

    @cached_property
    def tracks(self) -> dict[int, Track]:
        """The counters of each instance."""
        return tracks(self.rows, self.payloads, self.instances)

    @cached_property
    def culprits(self) -> dict[Culprit, Said]:
        """Whom events about loss name."""
        return culprits(self.payloads.events, self.instances)

    @cached_property
    def network(self) -> Network:
        """The Software Bus Network."""
        return Network(self.rows, self.payloads, self.instances, self.profile)

    @cached_property
    def hops(self) -> list[Hop]:
        """Streams that come out again as others."""
        return find_hops(self.streams, self.rows, self._follows)

    def _follows(self, into: Stream, out: Stream) -> bool:
        """Tell whether what arrives as one stream may leave as another: of the same cFS, not its sibling."""
        if into.link is Link.CI:
            return True
        arrives = self.network.identity_of.get(into.receiver, "")
        if out.link is Link.TO:
            owner = self.instances.owner(out.sender, int(self.rows.time_ns[out.rows[0]]))
            leaves = self.instances.items[owner].name if owner != NOBODY else ""
        else:
            leaves = self.network.identity_of.get(out.sender, "")
        if arrives and leaves:
            return arrives == leaves
        return f"{into.processor[0]}:{into.processor[1]}" != leaves

    @cached_property
    def known(self) -> Known:
        """What losses are told from."""
        upstream = {id(hop.out): hop for hop in self.hops if not hop.rewritten}
        return Known(
            self.rows,
            self.streams,
            self.instances,
            self.tracks,
            self.culprits,
            self.network,
            upstream,
            self.profile,
        )

    @cached_property
    def losses(self) -> list[Loss]:
        """All that was lost, as far as it can be told."""
        telemetry = telemetry_losses(self.known)
        return [*telemetry, *app_losses(self.known, telemetry)]

    @cached_property
    def has_telemetry(self) -> bool:
        """Whether anything that a cFS sends is in the capture."""
        return bool(self.instances.items) or bool(np.any(self.rows.link == Link.TO))

    def route(self, msg_id: int, link: Link | None = None) -> Route | None:
        """Return the configured route of a MsgId, on a link or on any."""
        table = self.context.any_route_of if link is None else self.context.route_of[link]
        index = int(table[msg_id]) if 0 <= msg_id < len(table) else NO_ROUTE
        return self.mission.routes[index] if index != NO_ROUTE else None

    def topic(self, msg_id: int) -> str | None:
        """Return the configured topic of a MsgId, or None."""
        route = self.route(msg_id)
        return route.topic if route else None

    def name(self, msg_id: int) -> str:
        """Return how people are told of a MsgId: ``0x1827 (/cmd_vel)``."""
        told = self.topic(msg_id) or message_name(msg_id)
        return f"0x{msg_id:04x} ({told})" if told else f"0x{msg_id:04x}"

    def said(
        self, start_ns: int, end_ns: int, app: str = "", event_ids: Iterable[int] = ()
    ) -> list[EventRecord]:
        """Return the events of an application in a span of time."""
        wanted = set(event_ids)
        return [
            item
            for item in self.payloads.events
            if start_ns <= item.time_ns <= end_ns
            and (not app or item.app == app)
            and (not wanted or item.event_id in wanted)
        ]

    def at(self, time_ns: int) -> str:
        """Return a time as people are told of it: seconds into the capture."""
        return f"{max(0, time_ns - self.start_ns) / SECOND:.1f} s"

    def label(self, instance: int) -> str:
        """Return how people are told of an instance."""
        return "cFS" if instance == NOBODY else self.instances.items[instance].label

    def drops_text(self) -> tuple[str, ...]:
        """Return what has to be said before cFS is blamed."""
        if not self.capture.drops:
            return ()
        return (f"the capture itself lost {self.capture.drops:,} frames: some of this may be its own",)
