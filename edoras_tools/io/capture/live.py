"""Live capture from a network interface; on Linux a TPACKET_V3 ring in memory shared with the kernel.

``linux/if_packet.h``, ``net/packet/af_packet.c`` and ``Documentation/networking/packet_mmap.rst`` are the
reference. The kernel fills one block after another with packets, and releases each block when it is full or
old. The rest of a block that is closed by its age stays unused: closed every 20 ms, 64 blocks are about a
second. Therefore blocks are closed here when they are full, and the open one is read as well.

Rules that this file keeps:

1. A block is closed when the next packet does not fit, or after ``_RETIRE_MS``. A ring has enough blocks for
   minutes of traffic at any rate of a link.
2. Nobody waits for a full block: the open block is checked every ``FRESH_S``, and its packets are read. The
   count in its header says which packets the kernel had *begun* to write; after ``wait`` all of them
   are complete. No other sign of a complete packet is reliable: fields are written in any order. That wait
   can take seconds, so another thread does it; meanwhile the block is closed by its age, and read then.
3. If it is not possible to wait for the kernel, blocks are closed by age (``FRESH_S``), and the open one is
   not read.
4. A closed block is copied from where reading of the open one ended, and returned at once, with its count set
   to 0: until the kernel opens it again, the header would show the old count.
5. If an interface goes away, the socket is kept. If it returns with the same index, the kernel attaches it
   again as soon as it is up; with another index, the same socket is bound to it, which needs no privilege.
   ``outages`` says from when to when it was away.

``Barrier`` waits until the kernel has finished every packet that it had begun to write at the time of the
call. ``membarrier(2)`` with ``MEMBARRIER_CMD_GLOBAL`` is a ``synchronize_rcu()``
(``kernel/sched/membarrier.c``). The kernel delivers packets to sockets inside RCU read sections. If a thread
saw a part of what a section wrote before that call, it sees everything that the section wrote after it. The
call takes some 10 ms and no CPU time; where the processors are busy it takes up to seconds, so ``Barrier``
has a thread for it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import mmap
import os
import platform
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from edoras_tools.errors import CaptureError, OnFailure
from edoras_tools.io.capture import bpf, device, tpacket
from edoras_tools.io.capture.scapy_backend import ScapySource
from edoras_tools.model import InterfaceOutage, SourceInfo
from edoras_tools.wire.arrays import PADDING, Octets

if TYPE_CHECKING:
    from edoras_tools.io.frames.frame_batch import FrameBatch

_NUMBERS: Final = {"x86_64": 324, "aarch64": 283, "riscv64": 283, "armv7l": 389, "ppc64le": 365, "s390x": 356}
"""Number of the system call, by machine; the C library has no name for it."""
_QUERY: Final = 0
_GLOBAL: Final = 1 << 0
_REAL_TIME: Final = Path("/sys/kernel/realtime")


@cache
def available() -> bool:
    """Return whether this system has the call, and the call waits for sections.

    It is not available if processors run without a timer tick (``nohz_full``). A real-time kernel may
    interrupt a section to run a program, and on a single processor the call does not wait.
    """
    number = _NUMBERS.get(platform.machine())
    if number is None or ctypes.sizeof(ctypes.c_void_p) != ctypes.sizeof(ctypes.c_long):
        return False
    commands = _call(_QUERY)
    return commands > 0 and bool(commands & _GLOBAL) and not _REAL_TIME.exists()


def wait() -> bool:
    """Wait until every packet that the kernel has begun is complete; return whether it succeeded."""
    return _call(_GLOBAL) == 0


class Barrier:
    """Waits in a thread of its own. One ``ask`` at a time: the next one after its answer."""

    def __init__(self) -> None:
        self._asks: SimpleQueue[bool] = SimpleQueue()
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._succeeded = False
        self._thread = threading.Thread(target=self._run, name="capture barrier", daemon=True)
        self._thread.start()

    def fileno(self) -> int:
        """Return a file descriptor that becomes readable with the answer."""
        return self._event

    def ask(self) -> None:
        """Begin to wait."""
        self._asks.put(True)

    def answer(self) -> bool | None:
        """Return whether waiting succeeded, once; None while it lasts."""
        try:
            os.eventfd_read(self._event)
        except BlockingIOError:
            return None
        return self._succeeded

    def close(self) -> None:
        """End the thread."""
        self._asks.put(False)
        self._thread.join()
        os.close(self._event)

    def _run(self) -> None:
        while self._asks.get():
            self._succeeded = wait()
            os.eventfd_write(self._event, 1)


def _call(command: int) -> int:
    return int(_syscall()(_NUMBERS[platform.machine()], command, 0, 0))


@cache
def _syscall() -> ctypes._NamedFuncPointer:
    return ctypes.CDLL(None, use_errno=True).syscall


_SOL_PACKET: Final = 263
_PACKET_ADD_MEMBERSHIP: Final = 1
_PACKET_RX_RING: Final = 5
_PACKET_STATISTICS: Final = 6
_PACKET_VERSION: Final = 10
_PACKET_VNET_HDR: Final = 15
_PACKET_IGNORE_OUTGOING: Final = 23
_PACKET_MR_PROMISC: Final = 1
_TPACKET_V3: Final = 2
_ETH_P_ALL: Final = 3
_STATUS_USER: Final = 1
_STATUS_KERNEL: Final = 0
_STATUS, _COUNT, _FIRST, _LENGTH = 2, 3, 4, 5
"""Words of a block's descriptor."""

_LINK_TYPES: Final = {1: bpf.ETHERNET, 772: bpf.ETHERNET, 519: bpf.RAW, 65534: bpf.RAW}
"""By ARPHRD type: ETHER, LOOPBACK, RAWIP, NONE (a tun); frames of others are captured without header."""
_FRAME_SIZE: Final = 2048  # it only has to divide the block size: V3 packs packets of any size
_AT_ONCE: Final = 4 << 20
"""Maximum bytes that one read copies, unless a single block is larger."""
FRESH_S: Final = 0.02
"""Maximum age of packets in the open block before they are read."""
_LINGER_S, _BUSY_LINGER_S = 1.0, 0.05
_CHECKED_S: Final = 0.4
"""A ring that holds traffic of this time, at ``_FILL_RATE``, is only checked five times a second."""
_ENOUGH: Final = 2 << 20
"""Bytes that a read should find: reading a block alone costs as much as ten."""
_FILL_RATE: Final = 320_000_000
"""Bytes per second that a ring must hold: four times those of 300,000 small frames."""
_RETIRE_MS: Final = 500
"""Age at which the kernel closes a block that is read while it is open."""
_RING_BYTES: Final = 128 << 20
_SHARE_OF_MEMORY: Final = 32
"""Size of a ring: ``_RING_BYTES``, or this part of the machine's memory if that is less."""
_WATCH_S: Final = 0.1
"""How often the state of an existing interface is checked."""


class _Piece(NamedTuple):
    """The part of a block to read: the block, first and last byte, and the number of packets."""

    block: int
    first: int
    end: int
    packets: int


class Ring(device.Device):
    """A packet socket on one interface, or on all, that receives through a ring.

    After the constructor no packet is missed without being counted: ``drops`` counts what does not fit.

    Args:
        interface: its name, or ``any``.
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
        block_size: bytes of a block; a multiple of the page size that holds the largest frame.
        blocks: number of blocks; by default from ``_RING_BYTES``; halved until the kernel has enough memory.
        snap_length: bytes of a frame to keep.
        wait: if the interface does not exist or is down, treat it as one that is away now.

    Attributes:
        linger_s: time for which frames may gather; the ring holds more. 0 while a read waits for the barrier.

    Raises:
        CaptureError: no such interface, it is down, a privilege is missing, or there are too many ports.
    """

    def __init__(
        self,
        interface: str,
        ports: Iterable[int] = (),
        *,
        streams: Iterable[int] = (),
        begins: Sequence[bytes] = (),
        block_size: int = 1 << 17,
        blocks: int = 0,
        snap_length: int = 262144,
        wait: bool = False,
    ) -> None:
        if not hasattr(socket, "AF_PACKET"):
            raise CaptureError("packet rings are a Linux feature: use the scapy back end on this system")
        current = _existing_interface(interface) if wait else device.find_interface(interface)
        if not wait and not current.up:
            raise CaptureError(
                f"{interface} is down: switch it on with 'ip link set {interface} up', or -i wait:{interface}"
            )
        walks = available()
        super().__init__(_BUSY_LINGER_S, look_s=FRESH_S if walks else _WATCH_S)
        self.info = SourceInfo(interface, "live", snap_length=snap_length)
        self._enough_s = _BUSY_LINGER_S
        self._copied = time.monotonic()
        self._ports = tuple(ports)
        self._streams = tuple(streams)
        self._begins = begins
        self._block_size = block_size
        self._blocks = blocks or _blocks(block_size)
        self._delivered = self._read = self._made = self._back_ns = 0
        self._refusing = False
        self._watched = 0.0
        self._turn = 0
        self._asked: tuple[int, int] | None = None
        """Turn and count of the open block that the barrier waits for."""
        self._barrier = Barrier() if walks else None
        with OnFailure(self._end_barrier):
            self._open(current)

    def _open(self, interface: device.Interface) -> None:
        """Create socket and ring for this kind of interface, and bind it if the interface exists."""
        self._link_type = _LINK_TYPES.get(interface.hardware_type, bpf.LINUX_SLL2)
        if interface.loopback:
            loopback: int | None = interface.index
        else:
            loopback = device.loopback_index() if interface.name == device.ANY_INTERFACE else None
        cooked = self._link_type == bpf.LINUX_SLL2
        # The kernel marks packets of several datagrams, but not on a cooked socket. A socket of all
        # interfaces is therefore raw, and cooked headers are written by ``tpacket``.
        self._marked = _marks_segments() and (not cooked or interface.name == device.ANY_INTERFACE)
        program = bpf.port_filter(
            self._link_type,
            self._ports,
            streams=self._streams,
            begins=self._begins,
            snap_length=self.info.snap_length,
            loopback=loopback,
            whole=cooked and self._marked,
        )
        self._next = self._seen = self._resume = 0
        self._turn += 1
        self._looked = 0.0
        self._socket = _socket(interface.name, cooked=cooked and not self._marked)
        try:
            self._start(interface, program)
        except OSError as error:
            self._socket.close()
            raise CaptureError(f"{interface.name}: {error.strerror}") from error

    def _start(self, interface: device.Interface, program: Sequence[bpf.Instruction]) -> None:
        """Set filter, then ring, then bind: in this order, every packet in the ring has passed the filter."""
        bpf.attach_program(self._socket, program)
        self._socket.setsockopt(_SOL_PACKET, _PACKET_VERSION, _TPACKET_V3)
        if self._marked:
            self._socket.setsockopt(_SOL_PACKET, _PACKET_VNET_HDR, 1)
        blocks = self._allocate()
        self._map = mmap.mmap(self._socket.fileno(), blocks * self._block_size)
        self._ring = np.frombuffer(self._map, dtype=np.uint8).reshape(blocks, self._block_size)
        self._headers = self._ring[:, : tpacket.BLOCK_HEADER].view(np.uint32)
        if interface.loopback:
            with contextlib.suppress(OSError):  # before Linux 4.20 only the filter does it
                self._socket.setsockopt(_SOL_PACKET, _PACKET_IGNORE_OUTGOING, 1)
        self._bound = 0
        if interface.name == device.ANY_INTERFACE:
            self._bind_all()
        elif interface.index:
            self._bind(interface)
        if not (interface.up and interface.carrier):
            self._leave(interface)

    def _bind(self, interface: device.Interface) -> None:
        """Receive from an interface; if it is down, the kernel attaches it when it comes up."""
        if not interface.loopback:
            member = struct.pack("=iHH8s", interface.index, _PACKET_MR_PROMISC, 0, b"")
            self._socket.setsockopt(_SOL_PACKET, _PACKET_ADD_MEMBERSHIP, member)
        self._socket.bind((interface.name, _ETH_P_ALL))
        self._bound = interface.index

    def _bind_all(self) -> None:
        """Bind to interface number 0, which means all; the socket module has no name for it."""
        address = struct.pack("=HHiHBB8x", socket.AF_PACKET, socket.htons(_ETH_P_ALL), 0, 0, 0, 0)
        library = ctypes.CDLL(None, use_errno=True)
        if library.bind(self._socket.fileno(), address, len(address)) != 0:
            code = ctypes.get_errno()
            raise OSError(code, os.strerror(code))

    def _allocate(self) -> int:
        """Request a ring, halved while the kernel has too little memory; return the number of blocks."""
        blocks, retire_ms = self._blocks, _RETIRE_MS if self._barrier else round(FRESH_S * 1000)
        while True:
            frames = blocks * self._block_size // _FRAME_SIZE
            request = struct.pack("=7I", self._block_size, blocks, _FRAME_SIZE, frames, retire_ms, 0, 0)
            try:
                self._socket.setsockopt(_SOL_PACKET, _PACKET_RX_RING, request)
            except OSError as error:
                if error.errno != errno.ENOMEM or blocks == 1:
                    raise
                blocks //= 2
            else:
                return blocks

    def filenos(self) -> tuple[int, ...]:
        """Return the file descriptors that become readable when a block is ready, or may be read."""
        return (self._socket.fileno(), *((self._barrier.fileno(),) if self._barrier else ()))

    def read(self) -> FrameBatch | None:
        """Read the blocks that the kernel has released, at most a few MiB, or else the open block.

        Returns:
            The frames; None if there is nothing new.
        """
        pieces, ended = self._closed()
        if not pieces and (count := self._first_block()):
            pieces, ended = self._closed()  # it may have been closed meanwhile
            if not pieces:
                pieces = [self._piece(count)]
                self._seen = count
        if not pieces:
            return None
        data, runs = self._copy(pieces)
        self._filled(data.size)
        for block in ended:
            self._headers[block, _COUNT] = 0
            self._headers[block, _STATUS] = _STATUS_KERNEL
        if not runs:
            return None
        heads = tpacket.packet_heads(data, runs)
        if not ended:
            last = int(heads[-1])
            self._resume = pieces[0][1] + last + tpacket.behind(data, last)
        frames = tpacket.frames(data, heads, self._link_type, self._made + 1, described=self._marked)
        self._read += len(heads)
        self._made += len(frames)
        self._arrived(frames)
        return frames

    def _filled(self, size: int) -> None:
        """Set how long frames may gather from now on, from the rate of the bytes read."""
        now = time.monotonic()
        longest_s = _LINGER_S if (holds_s := self._ring.size / _FILL_RATE) >= _CHECKED_S else holds_s
        self._enough_s = min(longest_s, max(_ENOUGH * (now - self._copied) / size, _BUSY_LINGER_S))
        self._copied = now
        if self._asked is None:
            self.linger_s = self._enough_s

    def _copy(self, pieces: Sequence[_Piece]) -> tuple[Octets, list[tpacket.PacketRun]]:
        """Copy pieces out of the ring, each padded to a multiple of ``ALIGNMENT``."""
        sizes = [-(-(piece.end - piece.first) // tpacket.ALIGNMENT) * tpacket.ALIGNMENT for piece in pieces]
        data = np.empty(sum(sizes) + PADDING, dtype=np.uint8)
        data[-PADDING:] = 0
        runs: list[tpacket.PacketRun] = []
        at = 0
        for piece, size in zip(pieces, sizes, strict=True):
            end = at + piece.end - piece.first
            data[at:end] = self._ring[piece.block, piece.first : piece.end]
            if piece.packets:
                runs.append(tpacket.PacketRun(at, end, piece.packets))
            at += size
        return data, runs

    def _closed(self) -> tuple[list[_Piece], list[int]]:
        """Return the unread parts of closed blocks, at most a few MiB, and the numbers of these blocks."""
        pieces: list[_Piece] = []
        ended: list[int] = []
        size = 0
        while len(ended) < len(self._ring):
            header = self._headers[self._next]
            length = int(header[_LENGTH])
            if not header[_STATUS] & _STATUS_USER or (ended and size + length > _AT_ONCE):
                break
            pieces.append(self._piece(int(header[_COUNT])))
            ended.append(self._next)
            size += length
            self._seen = self._resume = 0
            self._next = (self._next + 1) % len(self._ring)
            self._turn += 1
        return pieces, ended

    def _first_block(self) -> int:
        """Return how many packets of the open block are complete and may be read now; 0 if none is new."""
        if self._barrier is None:
            return 0
        if self._asked:
            succeeded = self._barrier.answer()
            if succeeded is None:
                return 0
            (turn, count), self._asked = self._asked, None
            self.linger_s, self._looked = self._enough_s, time.monotonic()
            if succeeded and turn == self._turn:
                return count
        now = time.monotonic()
        count = int(self._headers[self._next, _COUNT])
        if count > self._seen and (now - self._looked >= FRESH_S or self._refusing):
            self._looked = now
            self._asked = self._turn, count
            self.linger_s = 0.0
            self._barrier.ask()
        return 0

    def _piece(self, count: int) -> _Piece:
        """Return the unread part of the next block, of which ``count`` packets are complete."""
        header = self._headers[self._next]
        return _Piece(
            self._next, self._resume or int(header[_FIRST]), int(header[_LENGTH]), count - self._seen
        )

    def count(self) -> None:
        """Read the kernel's counters, which resets them."""
        packets, drops, _ = struct.unpack("=3I", self._socket.getsockopt(_SOL_PACKET, _PACKET_STATISTICS, 12))
        self._delivered += packets - drops
        self.drops += drops

    def pressed(self) -> bool:
        """Return whether a quarter of the ring is full."""
        ahead = (self._next + len(self._ring) // 4) % len(self._ring)
        return bool(self._headers[ahead, _STATUS] & _STATUS_USER)

    def refuse(self) -> None:
        """Drop every packet from now on; packets in the ring stay."""
        bpf.attach_program(self._socket, bpf.NOTHING)
        self._refusing = True

    def drained(self) -> bool:
        """Return whether everything that the kernel put into the ring has been read."""
        self.count()
        return self._read >= self._delivered

    def failure(self) -> str | None:
        """Check the interface; return why no more packets will come, or None."""
        error = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error not in (0, errno.ENETDOWN):
            return f"{self.info.name}: {os.strerror(error)}"
        now = time.monotonic()
        if self.info.name == device.ANY_INTERFACE or not (
            error or self._away or now - self._watched >= _WATCH_S
        ):
            return None
        self._watched = now
        try:
            self._watch(was_down=bool(error))
        except CaptureError as failure:
            return str(failure)
        return None

    @property
    def _away(self) -> bool:
        return bool(self.outages) and not self.outages[-1].end_ns

    def _watch(self, *, was_down: bool) -> None:
        """Follow an interface that goes away and comes back.

        Raises:
            CaptureError: it came back as another kind of interface, and no socket may be opened for it.
        """
        current = _existing_interface(self.info.name)
        if current.index and current.index != self._bound:
            if _LINK_TYPES.get(current.hardware_type, bpf.LINUX_SLL2) != self._link_type:
                if not self.drained():
                    return
                self._reopen(current)
            else:
                with contextlib.suppress(OSError):  # gone again
                    self._bind(current)
        is_present = current.up and current.carrier and current.index == self._bound
        if is_present and self._away:
            back_ns = min(self._back_ns or time.time_ns(), time.time_ns())
            self.outages[-1] = replace(self.outages[-1], end_ns=back_ns)
        elif not is_present and not self._away:
            self._leave(current)
        elif is_present and was_down:  # down and up again between two checks
            self._leave(replace(current, up=False))
            self.outages[-1] = replace(self.outages[-1], end_ns=self.outages[-1].start_ns)

    def _leave(self, interface: device.Interface) -> None:
        why = "not there" if not interface.index else "without carrier" if interface.up else "down"
        self.outages.append(InterfaceOutage(interface.name, why, time.time_ns()))
        self._back_ns = 0

    def _arrived(self, frames: FrameBatch) -> None:
        """Store the time of the first frame after an outage: the interface is back, noticed or not."""
        if self._away and not self._back_ns:
            after = frames.time_ns[frames.time_ns > self.outages[-1].start_ns]
            self._back_ns = int(after[0]) if len(after) else 0

    def _reopen(self, interface: device.Interface) -> None:
        """Open a new socket under the old file descriptor, so that threads that poll it need not know."""
        before = self._socket
        self._release()
        self._open(interface)
        os.dup2(self._socket.fileno(), before.fileno())
        self._socket.close()
        self._socket = before
        self._delivered = self._read

    def _release(self) -> None:
        del self._headers, self._ring
        self._map.close()

    def close(self) -> None:
        """Release thread, socket and memory."""
        self._end_barrier()
        self._socket.close()
        self._release()

    def _end_barrier(self) -> None:
        if self._barrier:
            self._barrier.close()


def _socket(interface: str, *, cooked: bool) -> socket.socket:
    """Open a packet socket that receives nothing until it is bound."""
    kind = socket.SOCK_DGRAM if cooked else socket.SOCK_RAW
    with contextlib.suppress(PermissionError):
        return socket.socket(socket.AF_PACKET, kind, 0)
    device.claim_raw_sockets()
    try:
        return socket.socket(socket.AF_PACKET, kind, 0)
    except PermissionError:
        raise device.denied(interface) from None


def _existing_interface(name: str) -> device.Interface:
    """Look up an interface that may be away; if so, it has index 0 and is assumed to be Ethernet.

    Raises:
        CaptureError: no interface can have that name.
    """
    try:
        return device.find_interface(name)
    except CaptureError:
        if not device.possible(name):
            raise
        return device.Interface(name, index=0, hardware_type=1, up=False, loopback=False, carrier=False)


def _marks_segments() -> bool:
    """Return whether the kernel marks packets of several datagrams: before Linux 6.2 it drops them."""
    release = re.match(r"(\d+)\.(\d+)", os.uname().release)
    return release is not None and (int(release[1]), int(release[2])) >= (6, 2)


def _blocks(block_size: int) -> int:
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return max(1, min(_RING_BYTES, memory // _SHARE_OF_MEMORY) // block_size)


def open_live(
    interface: str,
    ports: Iterable[int] = (),
    *,
    streams: Iterable[int] = (),
    begins: Sequence[bytes] = (),
    ready: Callable[[], None] | None = None,
    on_outage: Callable[[InterfaceOutage], None] | None = None,
    wait: bool = False,
) -> device.DeviceSource:
    """Start capturing from an interface: through a ring shared with the kernel; without Linux, with scapy.

    Args:
        interface: its name, or ``any`` (ring only).
        ports: UDP ports to capture, source or destination; if empty, every UDP datagram.
        streams: TCP ports to capture; if empty, none.
        begins: see ``port_filter``.
        ready: called once when ``batches`` starts; nothing that arrives after construction is missed.
        on_outage: see ``DeviceSource``.
        wait: if the interface does not exist or is down, treat it as one that is away now (ring only).

    Raises:
        CaptureError: no such interface, it is down, a privilege is missing, or there are too many ports.
    """
    if hasattr(socket, "AF_PACKET"):
        ring = Ring(interface, ports, streams=streams, begins=begins, wait=wait)
        return device.DeviceSource(ring, ready=ready, on_outage=on_outage)
    return ScapySource(interface, ports, streams=streams, begins=begins, ready=ready)
