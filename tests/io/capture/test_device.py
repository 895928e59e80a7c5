"""The thread, the queue and the hand-over that all live sources share, on a device made of lists."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import numpy as np
import pytest
from msgspec.structs import replace
from waiting import until

from edoras_tools.errors import CaptureError
from edoras_tools.io.capture.device import Device, DeviceSource
from edoras_tools.io.frames.frame_batch import frames_of
from edoras_tools.model import Endpoint, InterfaceOutage, SourceInfo


def frames(payload, number):
    here = Endpoint("127.0.0.1", 1234)
    return frames_of([(number * 1000, here, here, payload)], number)


class Fake(Device):
    """A device that gives what it was told to, then what comes from the test."""

    def __init__(self, *items, why=None, holds=()):
        super().__init__(linger_s=0.0, look_s=0.1)
        self.info = SourceInfo("fake", "live")
        self.items = list(items)
        self.why = why
        self.holds = list(holds)  # comes out only once nothing more gets in
        self.reads = 0
        self.refused = self.closed = 0
        self.full = False
        self.pipe = os.pipe()

    def filenos(self):
        return (self.pipe[0],)

    def read(self):
        self.reads += 1
        if not self.items:
            return None
        item = self.items.pop(0)
        if isinstance(item, Exception):
            raise item
        return item

    def count(self):
        self.drops += 1

    def pressed(self):
        return self.full

    def refuse(self):
        self.refused += 1
        self.items += self.holds
        self.holds = []

    def drained(self):
        return not self.items

    def failure(self):
        return self.why

    def close(self):
        self.closed += 1
        for end in self.pipe:
            os.close(end)


@pytest.fixture
def source_of():
    sources = []

    def make(device, **options):
        sources.append(DeviceSource(device, idle_s=0.01, **options))
        return sources[-1]

    yield make
    for source in sources:
        source.close()


def payloads(batches):
    return [batch[row].payload for batch in batches for row in range(len(batch))]


def first(batches):
    """The first that is no sign of life only."""
    return next(batch for batch in batches if len(batch))


def test_everything_comes_in_order_and_is_counted(source_of):
    device = Fake(*(frames(bytes([number]) * 5, number) for number in range(1, 6)))
    source = source_of(device)
    source.stop()
    assert payloads(source.batches()) == [bytes([number]) * 5 for number in range(1, 6)]
    statistics = source.statistics
    assert (statistics.frames, statistics.datagrams, statistics.skipped) == (5, 5, 0)
    assert statistics.bytes == 5 * (28 + 5)
    assert statistics.kernel_drops > 0
    assert source.info is device.info


def test_ready_comes_first_and_once(source_of):
    calls = []
    source = source_of(Fake(frames(b"x", 1)), ready=lambda: calls.append(source.started.is_set()))
    assert not source.started.is_set()
    assert calls == []
    source.stop()
    assert len(payloads(source.batches())) == 1
    assert calls == [True]


def test_silence_is_handed_over_as_empty_batches(source_of):
    source = source_of(Fake())
    batches = source.batches()
    for _ in range(3):
        batch = next(batches)
        assert len(batch) == 0
        assert batch.take(slice(0)).ipv6 == ()
    source.stop()
    assert payloads(batches) == []


def test_stop_takes_what_the_device_still_holds(source_of):
    device = Fake(frames(b"early", 1), holds=[frames(b"held", 2)])
    source = source_of(device)
    batches = source.batches()
    assert payloads([first(batches)]) == [b"early"]
    source.stop()
    source.stop()
    assert payloads(batches) == [b"held"]
    assert device.refused == 1


def test_who_is_behind_is_given_all_that_waits_at_once(source_of):
    """Batches of one are dear: a consumer that could not keep up catches up with large ones."""
    device = Fake(*(frames(b"%d" % number, number) for number in range(1, 51)))
    source = source_of(device)
    until(lambda: not device.items)
    source.stop()
    batches = [batch for batch in source.batches() if len(batch)]
    assert payloads(batches) == [b"%d" % number for number in range(1, 51)]
    assert len(batches) < 3
    assert np.concatenate([batch.number for batch in batches]).tolist() == list(range(1, 51))


@pytest.mark.parametrize(
    ("later", "ends"), [([b"x" * 60_000] * 80, False), ([b"second", b"third"], True)], ids=["much", "stop"]
)
def test_frames_gather_until_many_wait_or_the_end(source_of, later, ends):
    """The first does not wait; of those behind it, none comes before its time, but for these reasons."""
    device = Fake(frames(b"first", 1))
    source = source_of(device)
    source.gather_s = 3600.0
    batches = source.batches()
    assert payloads([first(batches)]) == [b"first"]
    device.items += [frames(item, number) for number, item in enumerate(later, 2)]
    os.write(device.pipe[1], b"x")
    if ends:
        source.stop()
    got = payloads([first(batches)])
    assert got == later[: len(got)]
    assert len(got) > (1 if ends else 60)


@pytest.mark.parametrize("look_s", [0.1, 3600.0], ids=["looked at", "tells of each frame"])
def test_the_device_is_read_before_a_batch_is_due(look_s, source_of):
    """What is read in time is in that batch: it does not wait for the one after."""
    device = Fake(frames(b"first", 1))
    device.linger_s, device.look_s = 3600.0, look_s
    source = source_of(device)
    source.gather_s = 0.2
    batches = source.batches()
    first(batches)
    device.items.append(frames(b"second", 2))
    os.write(device.pipe[1], b"x")
    begun = time.monotonic()
    assert payloads([first(batches)]) == [b"second"]
    assert time.monotonic() - begun < 60


def test_a_device_that_cannot_hold_more_is_read_before_a_batch_is_due(source_of):
    device = Fake(frames(b"first", 1))
    device.linger_s = 3600.0
    source = source_of(device)
    source.gather_s = 3600.0
    batches = source.batches()
    assert payloads([first(batches)]) == [b"first"]
    device.items.append(frames(b"second", 2))
    os.write(device.pipe[1], b"x")
    device.full = True
    until(lambda: not device.items)


def test_an_interface_that_goes_away_is_told(source_of):
    """When it goes and when it is back, each once, in order."""
    device, told = Fake(), []
    source = source_of(device, on_outage=told.append)
    batches = source.batches()
    next(batches)
    away = [InterfaceOutage("eth1", "down", 10 * number) for number in range(3)]
    back = [replace(outage, end_ns=outage.start_ns + 5) for outage in away]
    for outages in ([away[0]], [away[0]], [back[0]], [*back[:2], away[2]], back, back):
        device.outages[:] = outages
        next(batches)
    assert told == [away[0], back[0], away[1], back[1], away[2], back[2]]
    assert source.statistics.outages == back


def test_a_failing_device_gives_everything_first(source_of):
    source = source_of(Fake(frames(b"before", 1), why="eth7 went down", holds=[frames(b"held", 2)]))
    seen = []
    with pytest.raises(CaptureError, match=r"^eth7 went down$"):
        seen.extend(source.batches())
    assert payloads(seen) == [b"before", b"held"]


@pytest.mark.parametrize("error", [CaptureError("udp: broken"), RuntimeError("a mistake in the device")])
def test_an_error_in_the_thread_reaches_the_consumer(source_of, error):
    source = source_of(Fake(frames(b"before", 1), error))
    seen = []
    with pytest.raises(type(error), match=str(error)):
        seen.extend(payloads([batch]) for batch in source.batches() if len(batch))
    assert seen == [[b"before"]]


def test_a_full_queue_leaves_the_rest_in_the_device(source_of):
    device = Fake(*(frames(b"y" * 1000, number) for number in range(100)))
    source = source_of(device, queue_bytes=5000)
    batches = source.batches()
    begun = payloads([first(batches)])
    # Five of about 1100 bytes fill the queue, and one was taken: the device keeps nearly all of the rest.
    assert len(device.items) > 80
    source.stop()
    assert len(begun + payloads(batches)) == 100
    assert device.items == []


def test_stop_from_a_signal_handler(source_of):
    source = source_of(Fake(frames(b"x", 1)))
    former = signal.signal(signal.SIGUSR1, lambda *_: source.stop())
    timer = threading.Timer(0.05, lambda: os.kill(os.getpid(), signal.SIGUSR1))
    try:
        timer.start()
        assert payloads(source.batches()) == [b"x"]
    finally:
        timer.join()
        signal.signal(signal.SIGUSR1, former)


def test_close_needs_no_consumer_and_may_come_twice(source_of):
    device = Fake(*(frames(b"y" * 1000, number) for number in range(100)))
    source = source_of(device, queue_bytes=2000)
    source.close()
    source.close()
    source.stop()
    assert device.closed == 1
    assert not any(thread.name == "capture fake" for thread in threading.enumerate())


def test_what_is_discarded_is_counted(source_of):
    source = source_of(Fake(*(frames(b"x", number) for number in range(1, 6)), holds=[frames(b"y", 6)]))
    batches = source.batches()
    shown = len(first(batches))
    assert shown + source.discard() == 6
    assert source.discard() == 0


CODE = """
    import ctypes, socket
    from edoras_tools.errors import CaptureError
    from edoras_tools.io.capture.device import claim_raw_sockets
    from edoras_tools.io.capture.live import _socket

    def state():
        with open("/proc/thread-self/status") as file:
            status = dict(line.split(":\\t", 1) for line in file)
        return [int(status[name], 16) for name in ("CapEff", "CapPrm")]

    header, values = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    values[1] = {permitted}
    assert ctypes.CDLL(None).capset(header, values) == 0
    assert state() == [0, {permitted}]
    try:
        _socket("lo", cooked=False).close()
        print("opened", *state())
    except CaptureError as error:
        print("refused", *state(), error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has a capability to give up")
@pytest.mark.parametrize(
    ("permitted", "seen"),
    [
        (1 << 13, "opened 8192 8192\n"),
        (0, "refused 0 0 lo: capturing needs CAP_NET_RAW: "),
        (1 << 12, "refused 0 4096 lo: capturing needs CAP_NET_RAW: "),
    ],
)
def test_what_is_permitted_is_used_and_nothing_more(permitted, seen):
    code = textwrap.dedent(CODE.format(permitted=permitted))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.startswith(seen), done.stderr
