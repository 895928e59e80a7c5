"""Files that cFE wrote: event logs and stored packets as captures, and the contents of others.

The packets of event logs and Data Storage, and the entries of reset logs, have dates. Each becomes a datagram
without addresses; its time is its mission time, and a command has the time of the packet before it. When they
are read with a capture, they are aligned to its clock.

An entry that cFE makes while it starts has no mission time, which has not begun yet: its stamp is the
processor's own clock. The first such entry of a power-on gets the time at which mission time begins, others
get the time of the entry before them.

Other files have no packets: markers of the performance log, a table, or text (``read_cfe_file``).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np

from edoras_tools.cfs import sbn
from edoras_tools.cfs.executive_services import MARKERS
from edoras_tools.cfs.profile import SbnPeerConfig
from edoras_tools.cfs.time_services import START_S
from edoras_tools.errors import CaptureError, os_errors
from edoras_tools.io.formats.capture_file import RecordSource, Window
from edoras_tools.io.frames.frame_batch import FrameBatch, FramePage, ends_of, walk_records
from edoras_tools.links.table import STORED
from edoras_tools.model import Endpoint, Peer, SourceInfo
from edoras_tools.units import SECOND
from edoras_tools.wire import ccsds, cfe
from edoras_tools.wire.arrays import Integers, Octets, Places, gather

if TYPE_CHECKING:
    from pathlib import Path

    from edoras_tools.wire.layout import Layout

_ENDS: Final = ends_of(Endpoint("0.0.0.0", 0), Endpoint("0.0.0.0", STORED.transport.ports[0]))  # noqa: S104


class CfePacketSource(RecordSource):
    """The packets of an event log, or of a file of Data Storage; the entries of a reset log.

    Attributes:
        header: the fields of ``FILE_HEADER``.
    """

    unit = "packet"
    header: Mapping[str, Any] = {}

    def __init__(self, window: Window) -> None:
        """Read the file header.

        Args:
            window: the file from its first byte on.

        Raises:
            CaptureError: the header is incomplete, or no packets follow it.
        """
        super().__init__(window)
        name = window.stream.name
        if not window.holds(cfe.FILE_HEADER.size):
            raise CaptureError(
                f"{name}: ends inside the cFE file header, at byte {window.end} of {cfe.FILE_HEADER.size}"
            )
        self.header = cfe.FILE_HEADER.parse(window.data[: cfe.FILE_HEADER.size].tobytes())
        subtype = self.header["subtype"]
        kind = cfe.kind_of(subtype)
        if subtype not in cfe.ON_TIME_LINE:
            raise CaptureError(
                f"{name}: is a cFE {kind}, which has no packets; 'edoras info {name}' shows what is in it"
            )
        if subtype == cfe.RESET_LOG:
            self.unit = "entry"
        self._at = cfe.OF_PACKETS.get(subtype, cfe.FILE_HEADER.size)
        self._info = SourceInfo(name, f"cFE {kind}")
        self._time_ns = (cfe.EPOCH_S + self.header["seconds"]) * SECOND
        self._clock_at = 0
        if not window.holds(self._at):
            raise CaptureError(
                f"{name}: ends inside Data Storage's header, at byte {window.end} of {self._at}"
            )

    def _frames(self) -> Iterator[FrameBatch]:
        window = self._window
        data, start, end = window.data, self._at, window.end
        if self.header["subtype"] == cfe.RESET_LOG:
            yield from self._entries(data, start, end)
            return

        def successor(positions: Integers) -> Integers:
            header = gather(data, positions, ccsds.PRIMARY.size)
            after: Integers = positions + ccsds.PRIMARY.size + 1
            after += ccsds.PRIMARY.column("packet_data_length", header)
            return after

        def step(position: int) -> int:
            return int(successor(np.array([position]))[0])

        positions, self._at = walk_records(start, end, np.empty(0, np.int64), successor, step)
        if len(positions):
            page = FramePage(len(positions), end - start)
            length = np.diff(np.append(positions, self._at))
            page.add(data, positions, length, self._times(data, positions), _ENDS)
            yield page.frames(self.statistics.frames + 1)

    def _entries(self, data: Octets, start: int, end: int) -> Iterator[FrameBatch]:
        """Yield the used entries of a reset log, oldest first."""
        positions = np.arange(start, end - cfe.RESET_ENTRY.size + 1, cfe.RESET_ENTRY.size)
        self._at = start + len(positions) * cfe.RESET_ENTRY.size
        rows = gather(data, positions, cfe.RESET_ENTRY.size)
        used = np.flatnonzero(cfe.RESET_ENTRY.column("entry_type", rows) > 0)
        if not len(used):
            return
        time_ns, order = reset_times(rows[used])
        positions, length = positions[used][order], np.full(len(used), cfe.RESET_ENTRY.size)
        page = FramePage(len(used), end - start)
        page.add(data, positions, length, time_ns[order], _ENDS)
        yield page.frames(self.statistics.frames + 1)

    def _times(self, data: Octets, positions: Integers) -> Integers:
        """Return the mission time of each packet as ns since 1970: i64 (n,)."""
        window = gather(data, positions, ccsds.PRIMARY.size + cfe.EXTENDED.size + cfe.TELEMETRY.size)
        if not self._clock_at:
            self._clock_at = self._where_time_is(window)
        telemetry = ccsds.PRIMARY.column("packet_type", window) == 0
        seconds, subseconds = (
            cfe.TELEMETRY.column(name, window, self._clock_at).astype(np.int64)
            for name in ("seconds", "subseconds")
        )
        time_ns = (cfe.EPOCH_S + seconds) * SECOND + subseconds * SECOND // 65536
        latest = np.maximum.accumulate(np.where(telemetry, np.arange(len(time_ns)), -1))
        time_ns = np.where(latest < 0, self._time_ns, time_ns[latest])
        self._time_ns = int(time_ns[-1])
        return time_ns

    def _where_time_is(self, window: Octets) -> int:
        """Return the offset of the time: of two candidates, the one nearer to the file header's time."""
        usual = ccsds.PRIMARY.size
        seconds = [
            cfe.TELEMETRY.column("seconds", window, at).astype(np.int64)
            for at in (usual, usual + cfe.EXTENDED.size)
        ]
        away = [np.abs(item - self.header["seconds"]).min() for item in seconds]
        return usual if away[0] <= away[1] else usual + cfe.EXTENDED.size


def reset_times(rows: Octets) -> tuple[Integers, Places]:
    """Return the time of each entry of a reset log, and the order in which the entries were made.

    The log is a ring: where mission time decreases from one entry to the next, the oldest entry follows.

    Args:
        rows: the entries, (n, ``RESET_ENTRY.size``) u8, in the file's order.

    Returns:
        Mission time as ns since 1970, i64 (n,); indices of the entries, oldest first.
    """
    core, power_on, subtype, seconds, subseconds = (
        cfe.RESET_ENTRY.column(name, rows).astype(np.int64)
        for name in ("entry_type", "reset_type", "reset_subtype", "seconds", "subseconds")
    )
    stamped = (core != 1) | np.isin(subtype, (cfe.RESET_COMMAND, cfe.EXCEPTION))
    begin = START_S * SECOND
    times = seconds * SECOND + (subseconds * SECOND >> 32)
    times = np.where(stamped, times, np.where(power_on == 2, begin, -1))
    dated = np.flatnonzero(times >= 0)
    falls = dated[1:][np.diff(times[dated]) < 0]
    order = np.roll(np.arange(len(rows)), -int(falls[0]) if len(falls) else 0)
    latest = np.maximum.accumulate(times[order])
    time_ns = np.empty(len(rows), np.int64)
    time_ns[order] = cfe.EPOCH_S * SECOND + np.where(latest < 0, begin, latest)
    return time_ns, order


_SUBSCRIPTIONS: Final = ("TO_LAB.TO_LAB_Subs", "TO_LAB_APP.TO_LAB_Subs")
"""Names of Telemetry Output's table."""
_SBN_BYTES: Final = (
    2 * (cfe.SBN_MODULES * cfe.SBN_MODULE.size + cfe.SBN_COUNT.size)
    + cfe.SBN_PEERS * cfe.SBN_PEER.size
    + cfe.SBN_PEER_COUNT.size
)
_LARGEST: Final = 64 << 20


class CfeFile(msgspec.Struct, frozen=True):
    """A file that cFE wrote.

    Attributes:
        path: path of the file.
        header: the fields of ``FILE_HEADER``.
        head: the fields of the second header, of a table or a performance log; else empty.
        entries: the fields of each entry of a log or a table; of a system log the lines, as ``text``.
        markers: events of a performance log, (n, 3) i64: marker number, 0 entry or 1 exit, time in ns.
    """

    path: Path
    header: dict[str, Any]
    head: dict[str, Any] = msgspec.field(default_factory=dict)
    entries: list[dict[str, Any]] = msgspec.field(default_factory=list)
    markers: Integers | None = None

    @property
    def kind(self) -> str:
        """The kind of file, such as ``table image``."""
        return cfe.kind_of(self.header["subtype"])

    @property
    def made_ns(self) -> int:
        """Mission time at which the file was made, ns since 1970; 0 for a table made on the ground."""
        return mission_ns(self.header) if self.header["seconds"] else 0

    @property
    def spans(self) -> Integers:
        """Each entry of a marker with its exit, by time, (n, 3) i64: marker, begin in ns, length in ns."""
        assert self.markers is not None
        rows = self.markers[np.argsort(self.markers[:, 0], kind="stable")]
        first, second = rows[:-1], rows[1:]
        pairs = (first[:, 0] == second[:, 0]) & (first[:, 1] == 0) & (second[:, 1] == 1)
        spans = np.stack([first[:, 0], first[:, 2], second[:, 2] - first[:, 2]], axis=1)[pairs]
        return spans[np.argsort(spans[:, 1], kind="stable")]

    def summary(self) -> dict[str, Any]:
        """Return the content in the shape of ``info --json``."""
        entries = self.entries if self.markers is None else list(_by_marker(self.markers[:, 0], self.spans))
        return {
            "source": str(self.path),
            "kind": f"cFE {self.kind}",
            **{name: self.header[name] for name in ("spacecraft_id", "processor_id", "description")},
            "made_ns": self.made_ns or None,
            **{name: value for name, value in self.head.items() if name not in {"spare", "reserved"}},
            "entries": entries,
        }


def marker_name(number: int) -> str:
    """Return the name of a marker of cFE; of a mission's own, its number: ``marker 36``."""
    return MARKERS.get(number, f"marker {number}")


def _by_marker(markers: Integers, spans: Integers) -> Iterator[dict[str, Any]]:
    for number in np.unique(markers).tolist():
        length_ns = spans[spans[:, 0] == number, 2]
        yield {
            "marker": number,
            "name": marker_name(number),
            "times": int((markers == number).sum()),
            "spans": len(length_ns),
            "total_ns": int(length_ns.sum()),
            "longest_ns": int(length_ns.max(initial=0)),
        }


def mission_ns(fields: dict[str, Any]) -> int:
    """Return a mission time in seconds and 1/2^32 s as ns since 1970."""
    return int((cfe.EPOCH_S + fields["seconds"]) * SECOND + (fields["subseconds"] * SECOND >> 32))


def read_cfe_file(path: Path) -> CfeFile | None:
    """Read a whole cFE file; None if it is another file, or contains packets and is read as a capture.

    Raises:
        CaptureError: the file cannot be read, or ends too early.
    """
    if not path.is_file():  # bytes of a pipe can be read only once
        return None
    at = cfe.FILE_HEADER.size
    with os_errors(f"{path}: cannot be read"), path.open("rb") as file:
        data = file.read(at)
        if not data.startswith(cfe.CFE_MAGIC):
            return None
        header = _parsed(path, cfe.FILE_HEADER, data, 0)
        if header["subtype"] in cfe.OF_PACKETS:
            return None
        data += file.read(_LARGEST)
    subtype = header["subtype"]
    if subtype == cfe.RESET_LOG:
        return CfeFile(path, header, entries=_resets(path, data[at:]))
    if subtype == cfe.SYSTEM_LOG:
        lines = data[at:].rstrip(b"\0").decode("utf-8", "replace").splitlines()
        return CfeFile(path, header, entries=[{"text": line} for line in lines])
    if subtype == cfe.PERFORMANCE_LOG:
        head = _parsed(path, cfe.PERFORMANCE, data, at)
        return CfeFile(path, header, head, markers=_markers(path, head, data[at + cfe.PERFORMANCE.size :]))
    if subtype == cfe.TABLE_IMAGE:
        head = _parsed(path, cfe.TABLE_HEADER, data, at)
        image = data[at + cfe.TABLE_HEADER.size :]
        if len(image) < head["load_bytes"]:
            raise CaptureError(f"{path}: ends after {len(image)} of the table's {head['load_bytes']} bytes")
        if not head["load_offset"] and head["table_name"] in _SUBSCRIPTIONS:
            return CfeFile(path, header, head, _subscriptions(image))
        if (head["load_offset"], head["table_name"], head["load_bytes"]) == (0, sbn.TABLE, _SBN_BYTES):
            return CfeFile(path, header, *_network(path, head, image))
        return CfeFile(path, header, head)
    return CfeFile(path, header)


def message_limits(path: Path) -> dict[int, int]:
    """Return the message limit of each MsgId in Telemetry Output's pipe, from an image of its table.

    Raises:
        CaptureError: the file cannot be read, or is not an image of that table.
    """
    table = read_cfe_file(path) if path.exists() else None
    if table is None or not table.entries or "message_limit" not in table.entries[0]:
        problem = "is not an image of Telemetry Output's table" if path.exists() else "there is no such file"
        raise CaptureError(f"{path}: {problem}; name one of {_SUBSCRIPTIONS[0]}")
    return {int(item["msg_id"], 16): item["message_limit"] for item in table.entries}


def network_peers(path: Path) -> tuple[SbnPeerConfig, ...]:
    """Return the peers in an image of SBN's table; cFS itself is one of them.

    Raises:
        CaptureError: the file cannot be read, or is not an image of that table in the usual size.
    """
    table = read_cfe_file(path) if path.exists() else None
    if table is None or table.head.get("table_name") != sbn.TABLE or "protocols" not in table.head:
        problem = "there is no such file"
        if path.exists():
            problem = f"is not an image of SBN's table, of {_SBN_BYTES} bytes"
        raise CaptureError(f"{path}: {problem}; name one of {sbn.TABLE}")
    peers = []
    for item in table.entries:
        host, _, port = item["address"].rpartition(":")
        numeric = port.isdecimal() and int(port) < 1 << 16
        peer = Peer(item["spacecraft_id"], item["processor_id"])
        peers.append(SbnPeerConfig(peer, int(port) if numeric else 0, host if numeric else item["address"]))
    return tuple(peers)


def _parsed(path: Path, layout: Layout, data: bytes, at: int) -> dict[str, Any]:
    if len(data) < at + layout.size:
        raise CaptureError(
            f"{path}: ends inside the {layout.title}, at byte {len(data)} of {at + layout.size}"
        )
    return layout.parse(data, at)


def _whole(path: Path, data: bytes, size: int, entries: str) -> int:
    """Return the number of entries of ``size`` bytes; an error if bytes remain."""
    count, rest = divmod(len(data), size)
    if rest:
        raise CaptureError(
            f"{path}: its {len(data)} bytes are no whole number of {entries} of {size} bytes; "
            "it was cut off, or another build of cFE made it"
        )
    return count


def _resets(path: Path, data: bytes) -> list[dict[str, Any]]:
    count = _whole(path, data, cfe.RESET_ENTRY.size, "entries")
    every = [cfe.RESET_ENTRY.parse(data, at * cfe.RESET_ENTRY.size) for at in range(count)]
    return [
        {
            "time_ns": mission_ns(item),
            **{slot.field.name: slot.field.text(item[slot.field.name]) for slot in cfe.RESET_ENTRY.slots[:2]},
            **{name: item[name] for name in ("reset_subtype", "processor_resets", "description")},
        }
        for item in every
        if item["entry_type"]
    ]


def _markers(path: Path, head: dict[str, Any], data: bytes) -> Integers:
    masks = 2 * 4 * head["mask_words"]
    if not head["ticks_per_second"] or masks > len(data):
        raise CaptureError(
            f"{path}: its header is not that of a performance log of a little-endian processor"
        )
    data = data[masks:]
    count = _whole(path, data, cfe.MARKER.size, "markers")
    rows = np.frombuffer(data, np.uint8).reshape(count, cfe.MARKER.size)
    number, upper, lower = (
        cfe.MARKER.column(slot.field.name, rows).astype(np.uint64) for slot in cfe.MARKER.slots
    )
    ticks = upper * np.uint64(head["rollover"] or 1 << 32) + lower
    ticks -= ticks[:1].sum()  # the first is the oldest
    time_ns = ticks.astype(np.float64) * (SECOND / head["ticks_per_second"])
    return np.stack([number % cfe.EXIT, number >= cfe.EXIT, time_ns.round()], axis=1).astype(np.int64)


def _subscriptions(image: bytes) -> list[dict[str, Any]]:
    entries = [
        cfe.TO_SUBSCRIPTION.parse(image, at)
        for at in range(0, len(image) - cfe.TO_SUBSCRIPTION.size + 1, cfe.TO_SUBSCRIPTION.size)
    ]
    used = next((at for at, item in enumerate(entries) if not item["msg_id"]), len(entries))
    return [{**item, "msg_id": f"0x{item['msg_id']:04x}"} for item in entries[:used]]


def _network(path: Path, head: dict[str, Any], image: bytes) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the head of SBN's table with its modules, and its peers."""
    at = 0
    modules = []
    for _ in range(2):
        count = cfe.SBN_COUNT.parse(image, at + cfe.SBN_MODULES * cfe.SBN_MODULE.size)["modules"]
        used = [
            cfe.SBN_MODULE.parse(image, at + place * cfe.SBN_MODULE.size)
            for place in range(min(count, cfe.SBN_MODULES))
        ]
        modules.append([item["name"] for item in used])
        at += cfe.SBN_MODULES * cfe.SBN_MODULE.size + cfe.SBN_COUNT.size
    count = cfe.SBN_PEER_COUNT.parse(image, at + cfe.SBN_PEERS * cfe.SBN_PEER.size)["peers"]
    if count > cfe.SBN_PEERS:
        raise CaptureError(
            f"{path}: names {count} peers, and the table has room for {cfe.SBN_PEERS}: "
            "it is big-endian, or damaged"
        )
    peers = []
    for place in range(count):
        item = cfe.SBN_PEER.parse(image, at + place * cfe.SBN_PEER.size)
        filters = (item[f"filter_{number}"] for number in range(cfe.SBN_FILTERS))
        peers.append(
            {
                **{
                    name: item[name]
                    for name in ("spacecraft_id", "processor_id", "address", "protocol", "net")
                },
                "filters": ", ".join(filter(None, filters)),
                "tasks": cfe.SBN_PEER.by_name["task_flags"].field.text(item["task_flags"]),
            }
        )
    return {**head, "protocols": ", ".join(modules[0]), "filters": ", ".join(modules[1])}, peers
