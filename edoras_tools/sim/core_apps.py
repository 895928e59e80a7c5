"""cFE's own five applications as far as a link shows them: no-op, counters, housekeeping once a second."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from edoras_tools.sessions import software_bus
from edoras_tools.sessions.events import EventType
from edoras_tools.sessions.profile import SECOND
from edoras_tools.sim.scheduler import Receive, Work
from edoras_tools.wire import cfe

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from edoras_tools.sessions.software_bus import Pipe
    from edoras_tools.sim.cfs import Cfs
    from edoras_tools.sim.scheduler import Task

RESET_ALL_FILTERS: Final = 14
LEAP_SECONDS: Final = 37
_HOUSEKEEPING_WORK: Final = 5


@dataclass(frozen=True, slots=True)
class Core:
    """What tells the five apart.

    Attributes:
        name: as events print it.
        pipe: its pipe's name.
        command: MsgId of its commands.
        request: MsgId of the housekeeping request.
        telemetry: MsgId of its housekeeping packet.
        others: further MsgIds that it subscribes to and that mean nothing here.
        initialised: number of the event at start.
        no_op: number of the no-op event.
        no_op_text: how that event begins.
        bad_length: number of the event for a no-op that is too long; None where none was seen.
        packets: function code to a packet that the command asks for: MsgId and payload bytes, sent as zeros.
    """

    name: str
    pipe: str
    command: int
    request: int
    telemetry: int
    others: tuple[int, ...]
    initialised: int
    no_op: int
    no_op_text: str
    bad_length: int | None = None
    packets: Mapping[int, tuple[int, int]] = field(default_factory=dict)


_NOOP: Final = "No-op Cmd Rcvd:  "
CORE: Final = (
    Core("CFE_EVS", "EVS_CMD_PIPE", 0x1801, 0x1809, 0x0801, (), 1, 0, _NOOP),
    Core(
        "CFE_SB", "SB_CMD_PIPE", 0x1803, 0x180B, 0x0803, (0x180E,), 1, 28, _NOOP, packets={2: (0x080A, 828)}
    ),
    Core("CFE_ES", "ES_CMD_PIPE", 0x1806, 0x1808, 0x0800, (), 1, 3, "No-op command:\n ", bad_length=23),
    Core(
        "CFE_TIME",
        "TIME_CMD_PIPE",
        0x1805,
        0x180D,
        0x0805,
        (0x1811, 0x1862),
        1,
        4,
        _NOOP,
        packets={2: (0x0806, 200)},
    ),
    Core("CFE_TBL", "TBL_CMD_PIPE", 0x1804, 0x180C, 0x0804, (), 1, 10, _NOOP),
)
"""In the order in which they start."""


def start_core(cfs: Cfs) -> None:
    """Start the five applications."""
    from edoras_tools.sim.cfs import VERSION

    profile = cfs.profile
    loss, nobody = profile.bus_loss_events, profile.bus_no_subscribers_events
    filters = {
        "CFE_SB": {
            software_bus.NO_SUBSCRIBERS: nobody,
            software_bus.MSG_LIMIT: loss,
            software_bus.PIPE_OVERFLOW: loss,
        }
    }
    for item in CORE:
        cfs.events.register(item.name, now=cfs.scheduler.now, stop_after=filters.get(item.name))
        pipe = cfs.create_pipe(item.pipe, item.command, item.request, *item.others)
        short = item.name.removeprefix("CFE_")
        cfs.say(item.name, item.initialised, f"cFE {short} Initialized:  {VERSION}")
        cfs.spawn(_run(cfs, item, pipe))


def _run(cfs: Cfs, core: Core, pipe: Pipe) -> Task:
    counters = [0, 0]
    body = _BODIES[core.name]
    while True:
        packet = yield Receive(pipe)
        wanted = software_bus.msg_id(packet)
        if wanted == core.request:
            yield Work(_HOUSEKEEPING_WORK * cfs.profile.work_ns)
            cfs.telemetry(core.telemetry, body(cfs, counters[0] & 0xFF, counters[1] & 0xFF), core.name)
        elif wanted == core.command:
            accepted = _command(cfs, core, packet)
            counters[not accepted] += 1
            if core.name == "CFE_SB":
                cfs.bus.counters.commands, cfs.bus.counters.command_errors = counters
            yield Work(cfs.profile.work_ns)


def _command(cfs: Cfs, core: Core, packet: bytes) -> bool:
    from edoras_tools.sim.cfs import VERSION

    function_code, size = packet[6] & 0x7F, software_bus.length(packet)
    if function_code == 0:
        if size != cfe.COMMAND_HEADER_BYTES:
            if core.bad_length is not None:
                text = f"Invalid msg length: ID = 0x{core.command:04X},  CC = 0, Len = {size}, Expected = 8"
                cfs.say(core.name, core.bad_length, text, EventType.ERROR)
            return False
        cfs.say(core.name, core.no_op, core.no_op_text + VERSION)
        return True
    if core.name == "CFE_EVS" and function_code == RESET_ALL_FILTERS:
        name = software_bus.whole(packet)[8:28].split(b"\0")[0].decode("ascii", "replace")
        return cfs.events.reset_filters(name)
    if function_code in core.packets:
        telemetry, size = core.packets[function_code]
        cfs.telemetry(telemetry, bytes(size), core.name)
        return True
    return False


def _executive(_: Cfs, commands: int, errors: int) -> bytes:
    return bytes([commands, errors]).ljust(148, b"\0")


def _events(cfs: Cfs, commands: int, errors: int) -> bytes:
    head = bytes([commands, errors, 1, 0, 0, 1, 0, 0]) + (cfs.events.sent & 0xFFFF).to_bytes(2, "little")
    applications = b"".join(
        index.to_bytes(4, "little")
        + (item.sent & 0xFFFF).to_bytes(2, "little")
        + bytes([1, min(item.squelched, 255)])
        for index, item in enumerate(cfs.events.applications.values(), 0x110001)
    )
    return (head.ljust(16, b"\0") + applications)[:144].ljust(144, b"\0")


def _bus(cfs: Cfs, _commands: int, _errors: int) -> bytes:
    return cfs.bus.housekeeping()


def _time(cfs: Cfs, commands: int, errors: int) -> bytes:
    seconds, rest = divmod(cfs.met_ns(), SECOND)
    words = (seconds, (rest << 32) // SECOND, cfs.profile.epoch_offset_s, 0)
    flags = bytes(2) + b"\xff\xff" + LEAP_SECONDS.to_bytes(2, "little")
    body = b"".join((word & 0xFFFFFFFF).to_bytes(4, "little") for word in words)
    return (bytes([commands, errors]) + flags + body).ljust(32, b"\0")


def _tables(_: Cfs, commands: int, errors: int) -> bytes:
    return bytes([commands, errors]).ljust(284, b"\0")


_BODIES: Final[Mapping[str, Callable[[Cfs, int, int], bytes]]] = {
    "CFE_ES": _executive,
    "CFE_EVS": _events,
    "CFE_SB": _bus,
    "CFE_TIME": _time,
    "CFE_TBL": _tables,
}
