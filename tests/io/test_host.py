"""The kernel's counters, from files of the kernel's own form and from the kernel that runs here."""

import socket
from contextlib import closing

import pytest
from waiting import until

from edoras_tools.io.host import read_host
from edoras_tools.model import HostCounters, SocketCounters

UDP = """\
   sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid  timeout inode ...
15491: 0100007F:04D2 00000000:0000 07 00000000:00001D40 00:00000000 00000000    0     0 86223 2 00000000 91
15492: 00000000:0009 00000000:0000 07 00000000:00000000 00:00000000 00000000    0     0 86224 2 00000000 5
15493: cut
"""
UDP6 = """\
  sl  local_address                         remote_address                        st tx_queue rx_queue tr ...
 1: 00000000000000000000000001000000:08BA 00000000000000000000000000000000:0000 07 00000000:00000000 \
00:00000000 00000000     0        0 777 2 00000000 3
"""
SNMP = "Ip: Forwarding ReasmFails\nIp: 2 4\nUdp: InDatagrams RcvbufErrors\nUdp: 100 91\n"
SNMP6 = "Ip6ReasmFails \t1\nUdp6RcvbufErrors \t2\n"
DEV = """\
Inter-|   Receive                                                |  Transmit
 face |bytes    packets errs drop fifo frame compressed multicast|bytes    packets
    lo: 152451444   45622    0    6    0     0          0         0 152451444   45622
  eth0:   1   1    0    7    0     0          0         0        0       0
"""


@pytest.fixture
def proc(tmp_path):
    files = {
        "net/udp": UDP,
        "net/udp6": UDP6,
        "net/snmp": SNMP,
        "net/snmp6": SNMP6,
        "net/dev": DEV,
        "stat": "cpu  10 20 30 40 0 0 0 5 0 0\ncpu0 1 2\n",
        "sys/fs/mqueue/msg_max": "10\n",
        "sys/net/core/rmem_default": "212992\n",
        "sys/net/core/rmem_max": "4194304\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_every_counter_is_read(proc):
    sockets = (SocketCounters(1234, "127.0.0.1", 86223, 0x1D40, 91), SocketCounters(2234, "::1", 777, 0, 3))
    assert read_host({1234, 2234}, 5, proc) == HostCounters(
        *(5, sockets, 93, 5, 13, 105, 5, 10, 212992, 4194304)
    )


def test_what_cannot_be_read_is_unknown(tmp_path):
    assert read_host({1234}, 5, tmp_path) == HostCounters(5)


def test_what_a_slow_reader_misses_is_what_the_kernel_counts():
    with (
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as slow,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
    ):
        slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
        slow.bind(("127.0.0.1", 0))
        slow.setblocking(False)
        port = slow.getsockname()[1]

        def counted():
            (found,) = read_host({port}, 0).sockets
            return found

        assert counted() == SocketCounters(port, "127.0.0.1", counted().inode, 0, 0)
        for _ in range(200):
            sender.sendto(bytes(76), ("127.0.0.1", port))
        assert counted().queued > 0
        read = 0
        while True:
            try:
                slow.recv(100)
            except BlockingIOError:
                break
            read += 1
        assert 0 < read < 200
        until(lambda: counted().drops == 200 - read, lambda: f"{counted()}, {read} read")
