"""cFE Event Services: filters, squelch, and the event packets that carry the texts of applications."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec.structs import replace

from edoras_tools.addons.lab.emulator.messages import link_id
from edoras_tools.cfs import event_services as facts
from edoras_tools.cfs.event_services import NAME, SQUELCHED, USUAL_TYPES, EventText, EventType
from edoras_tools.units import MILLISECOND
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.cfs.profile import SimProfile

_COST: Final = 1000
_LONGEST_TEXT: Final = 121  # char[122], the last one NUL


class Event(msgspec.Struct, frozen=True):
    """An event of an application.

    Attributes:
        app: name of the application.
        event_id: number of the event.
        event_type: severity.
        text: text, with names in braces for values.
        values: values by name; ``msg_id`` as on the bus.
    """

    app: str
    event_id: int
    event_type: EventType
    text: str
    values: Mapping[str, Any] = msgspec.field(default_factory=dict)

    @classmethod
    def of(cls, event: EventText, **values: object) -> Self:
        """Return an event of cFS with its values."""
        return cls(event.app, event.event_id, event.event_type, event.text, values)

    @property
    def message(self) -> str:
        """Text with its values; when it is sent, it is cut to 121 bytes."""
        return self.text.format(**self.values) if self.values else self.text

    def __str__(self) -> str:
        return f"{self.app} {self.event_id}: {self.message}"


class Application(msgspec.Struct):
    """The state of one application in Event Services.

    Attributes:
        name: name of the application.
        stop_after: event number to how many such events pass; a number that is absent always passes.
        tokens: thousandths of events that may still be sent.
        credited_ns: time when tokens were last added, ns.
        counts: event number to the events since the filter was reset.
        sent: events that were sent.
        squelched: events that were not sent because there were no tokens.
        enabled: whether it may send events at all.
        types: event types that it may send, one bit each: debug 1, information 2, error 4, critical 8.
    """

    name: str
    stop_after: Mapping[int, int]
    tokens: int
    credited_ns: int
    counts: dict[int, int] = msgspec.field(default_factory=dict)
    sent: int = 0
    squelched: int = 0
    enabled: bool = True
    types: int = USUAL_TYPES


class EventServices:
    """The events of one cFS instance.

    Attributes:
        applications: registered applications, in order.
        sent: events that were sent, of all applications.
    """

    def __init__(self, profile: SimProfile) -> None:
        self.profile = profile
        self.applications: dict[str, Application] = {}
        self.sent = 0

    def register(self, name: str, *, now: int, stop_after: Mapping[int, int] | None = None) -> None:
        """Register an application with its filters.

        Args:
            name: name of the application, at most 19 characters.
            now: ns.
            stop_after: event number to how many such events pass the filter.
        """
        self.applications[name] = Application(
            name, stop_after or {}, self.profile.event_burst * _COST, credited_ns=now
        )

    def unregister(self, name: str) -> None:
        """Remove an application."""
        self.applications.pop(name, None)

    def command(self, function_code: int, payload: bytes) -> list[Event]:
        """Process a command on events; return its events, none if it is another command."""
        answer = facts.DONE.get(function_code)
        if answer is None:
            return []
        applications, app, name_bytes = list(self.applications.values()), "", 0
        if function_code not in {facts.ENABLE_TYPE, facts.DISABLE_TYPE}:
            name_bytes = facts.APP_NAME_BYTES
            app = payload[:name_bytes].split(b"\0")[0].decode("ascii", "replace")
            if app not in self.applications:
                prefix = facts.UNKNOWN_APP_PREFIX.get(function_code, "")
                return [Event.of(facts.UNKNOWN_APP, prefix=prefix, app=app, code=function_code)]
            applications = [self.applications[app]]
        mask = int.from_bytes(payload[name_bytes : name_bytes + 1], "little")
        by_type = {facts.ENABLE_TYPE, facts.DISABLE_TYPE, facts.ENABLE_APP_TYPE, facts.DISABLE_APP_TYPE}
        if function_code in by_type and not 0 < mask <= facts.ALL_TYPES:
            return [Event.of(facts.BAD_MASK, mask=mask, code=function_code)]
        for item in applications:
            self._obey(function_code, item, mask)
        return [Event.of(answer, app=app, mask=mask)]

    def _obey(self, function_code: int, application: Application, mask: int) -> None:
        if function_code in {facts.ENABLE_TYPE, facts.ENABLE_APP_TYPE}:
            application.types |= mask
        elif function_code in {facts.DISABLE_TYPE, facts.DISABLE_APP_TYPE}:
            application.types &= ~mask
        elif function_code == facts.RESET_APP_COUNTER:
            application.sent = 0
        elif function_code == facts.RESET_ALL_FILTERS:
            application.counts.clear()
        else:
            application.enabled = function_code == facts.ENABLE_APP

    def report(self, event: Event, *, now: int) -> list[Event]:
        """Process an event; return the events to send: none, the event, or an event on the squelch."""
        application = self.applications.get(event.app)
        if application is None or not application.enabled:
            return []
        if not application.types >> (event.event_type - 1) & 1:
            return []
        count = application.counts[event.event_id] = application.counts.get(event.event_id, 0) + 1
        if count > application.stop_after.get(event.event_id, count):
            return []
        if not self._spend(application, now):
            application.squelched += 1
            if application.squelched > 1 or event.app == NAME:
                return []
            return self.report(Event.of(SQUELCHED, app=event.app), now=now)
        application.squelched = 0
        application.sent += 1
        self.sent += 1
        if "msg_id" in event.values:
            msg_id = link_id(event.values["msg_id"], self.profile)
            event = replace(event, values={**event.values, "msg_id": msg_id})
        return [event]

    def _spend(self, application: Application, now: int) -> bool:
        """Add tokens for the elapsed time, then take the cost of one event; return whether they sufficed."""
        credit = (now - application.credited_ns) * self.profile.event_rate // MILLISECOND
        if credit > 0:
            application.tokens = min(application.tokens + credit, self.profile.event_burst * _COST)
            application.credited_ns = now
        enough = application.tokens >= _COST
        # A negative balance makes an application wait longer, by at most one second's tokens.
        application.tokens = max(application.tokens - _COST, -self.profile.event_rate * _COST)
        return enough

    def payload(self, event: Event) -> bytes:
        """Return the payload of the event packet, 156 bytes."""
        return cfe.EVENT.emit(
            {
                "app_name": event.app.encode()[:19],
                "event_id": event.event_id,
                "event_type": event.event_type,
                "spacecraft_id": self.profile.spacecraft_id,
                "processor_id": self.profile.processor_id,
                "message": event.message.encode()[:_LONGEST_TEXT],
            }
        )
