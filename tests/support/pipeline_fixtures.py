"""What the tests of pipelines share: batches made of plain rows, and sources made of batches."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT
from waiting import HOST, PATIENCE_S

from edoras_tools.addons.proxy import run as proxy
from edoras_tools.addons.proxy.plan import ProxyPlan
from edoras_tools.addons.proxy.run import Proxy
from edoras_tools.io import SourceDefaults
from edoras_tools.io.net.buffer import DatagramBuffer
from edoras_tools.links.bare import CI
from edoras_tools.model import Columns, Endpoint, PacketBatch, SourceInfo, SourceStatistics
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import parse_rule

ANY = Endpoint(HOST, 0)


def _batch(rows):
    def column(kind, values):
        return np.array(list(values), dtype=kind)

    count = len(rows)
    zeros = np.zeros(count, dtype=np.int64)
    length = column("i4", (row.length for row in rows))
    batch = PacketBatch(
        data=np.zeros(65536 + 64, dtype=np.uint8),
        number=np.arange(1, count + 1),
        time_ns=column("i8", (row.time_ns for row in rows)),
        link_type=np.full(count, 101, dtype=np.uint16),
        frame_offset=zeros,
        frame_length=length,
        original_length=length,
        offset=zeros,
        length=length,
        source_address=np.full(count, 0x7F000001, dtype=np.uint32),
        source_port=column("u2", (row.port for row in rows)),
        destination_address=np.full(count, 0x7F000001, dtype=np.uint32),
        destination_port=np.full(count, 1235, dtype=np.uint16),
        ip_version=np.full(count, 4, dtype=np.uint8),
        capture_findings=np.zeros(count, dtype=np.uint32),
    )
    columns = Columns(
        link=column("u1", (row.link for row in rows)),
        spacecraft=np.ones(count, dtype=np.uint8),
        sbn_msg_type=column("i2", (row.sbn_msg_type for row in rows)),
        processor_id=column("u4", (row.processor_id for row in rows)),
        spacecraft_id=np.zeros(count, dtype=np.uint32),
        packet_offset=zeros,
        packet_length=length,
        msg_id=column("i4", (row.msg_id for row in rows)),
        sequence_flags=np.full(count, 3, dtype=np.uint8),
        sequence_count=column("u2", (row.sequence for row in rows)),
        function_code=np.full(count, -1, dtype=np.int16),
        mission_time_ns=np.full(count, -1, dtype=np.int64),
        header_length=np.zeros(count, dtype=np.uint8),
        headers=np.zeros(count, dtype=np.uint8),
        cdr_offset=np.full(count, -1, dtype=np.int64),
        cdr_length=np.zeros(count, dtype=np.int32),
        route=column("i2", (row.route for row in rows)),
        findings=column("u4", (row.findings for row in rows)),
    )
    return batch, columns


@pytest.fixture(scope="session")
def as_batch():
    """A function: rows with the attributes of ``row`` as a batch and its columns."""
    return _batch


@pytest.fixture(scope="session")
def row():
    """A function: a datagram as a ledger sees it; telemetry of MsgId 0x827 unless told otherwise."""

    def make(**values):
        usual = {
            "time_ns": 0,
            "length": 76,
            "port": 40000,
            "link": 2,
            "sbn_msg_type": -1,
            "processor_id": 0,
            "msg_id": 0x827,
            "sequence": 0,
            "route": -1,
            "findings": 0,
        }
        return SimpleNamespace(**(usual | values))

    return make


class _Source(SourceDefaults):
    """A source of given batches; calls what stands between them."""

    live = False

    def __init__(self, items, **statistics):
        self.info = SourceInfo("made up", "pcap")
        self.statistics = SourceStatistics(**statistics)
        self.closed = 0
        self._items = items

    def batches(self):
        for item in self._items:
            if isinstance(item, Exception):
                raise item
            if callable(item):
                item()
            else:
                self.statistics.datagrams += len(item)
                yield item

    def close(self):
        self.closed += 1


@pytest.fixture(scope="session")
def made_up():
    """A function: a source of these batches; among them errors are raised, functions called."""
    return _Source


@pytest.fixture(scope="session")
def captures():
    """A function: the path of a sample capture."""
    return lambda name: ROOT / f"samples/captures/{name}.pcap"


class Ends:
    """Sockets that are closed at the end, and proxies that are stopped."""

    def __init__(self, stack):
        self._stack = stack

    def port(self, number=0):
        """A bound socket, as a target."""
        opened = self._stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 << 20)
        opened.bind((HOST, number))
        opened.settimeout(PATIENCE_S)
        return opened

    def client(self, proxy):
        """A socket that speaks to a proxy."""
        opened = self.port()
        opened.connect((proxy.endpoint.address, proxy.endpoint.port))
        return opened

    def proxy(self, *targets, rules=(), seed=1, recorder=None, where=None, keys=None, **plan):
        """A running proxy."""
        faults = FaultPlan(tuple(parse_rule(rule) for rule in rules), seed)
        ends = tuple(Endpoint(*target.getsockname()) for target in targets)
        made = Proxy(
            ProxyPlan(**{"link": CI, "listen": ANY, "targets": ends, "faults": faults} | plan),
            recorder=recorder,
            where=where,
        )
        thread = threading.Thread(target=made.run, kwargs={"keys": keys})
        thread.start()

        def end():
            made.stop()
            thread.join(PATIENCE_S)
            assert not thread.is_alive()
            made.close()

        made.end = end
        self._stack.callback(end)
        return made


@pytest.fixture
def ends():
    """Sockets and running proxies, ended after the test."""
    with ExitStack() as stack:
        yield Ends(stack)


@pytest.fixture(params=["vectors", "plain"])
def arena(request, monkeypatch):
    """Both ways of moving datagrams."""
    if request.param == "plain":
        monkeypatch.setattr(proxy, "make_buffer", DatagramBuffer)


@pytest.fixture(scope="module")
def bench():
    """The decoders, without a mission."""
    return Settings().workbench()


@pytest.fixture
def batches(captures):
    """The datagrams of the rover in batches of a hundred, and one of none."""
    source = open_files([captures("a_rover")])
    whole = list(source.batches())
    source.close()
    assert len(whole) == 1
    hundreds = [whole[0].take(slice(start, start + 100)) for start in range(0, 1800, 100)]
    return [*hundreds[:3], whole[0].take(slice(0, 0)), *hundreds[3:]]
