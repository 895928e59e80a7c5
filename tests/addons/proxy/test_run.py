"""A proxy in a thread, clients and targets around it: who gets what, and what is counted."""

from __future__ import annotations

import os
import random
import time
from types import SimpleNamespace

import pytest
from effort import every
from msgspec.structs import replace
from waiting import HOST, arrived_at, free_ports, receive, until

from edoras_tools.addons.lab.emulator import Served, Simulation
from edoras_tools.addons.proxy.plan import ProxyPlan, limit_rule
from edoras_tools.addons.proxy.run import Proxy
from edoras_tools.cfs.profile import SimProfile
from edoras_tools.decode import ColumnDecoder, Context
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.net.sockets import SendResult
from edoras_tools.links.bare import CI, TO
from edoras_tools.links.sbn import SBN
from edoras_tools.mission import Mission, Route
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.faults import compiler
from edoras_tools.pipelines.reading import Keys
from edoras_tools.pipelines.workbench import Workbench
from edoras_tools.ros import TypeStore
from edoras_tools.units import MILLISECOND, SECOND
from edoras_tools.wire import cfe, envelope

ANY = Endpoint(HOST, 0)


def eventually(opened, count):
    """What arrives, once so many have, and a moment to see that there are no more."""
    found = receive(opened, count)
    time.sleep(0.05)
    return found + arrived_at(opened)


def numbered(count, size=12):
    return [
        cfe.emit_command(0x1827, 1, number.to_bytes(4, "big") + bytes(size - 4)) for number in range(count)
    ]


@pytest.mark.each(2)
def test_every_byte_goes_both_ways_in_order(ends, arena):
    target = ends.port()
    client = ends.client(ends.proxy(target))
    chance = random.Random(3)
    datagrams = [b"", bytes(65507), *(chance.randbytes(chance.randrange(1500)) for _ in range(1500))]
    for first in range(0, len(datagrams), 50):
        some = datagrams[first : first + 50]
        for datagram in some:
            client.send(datagram)
        back = [target.recvfrom(65536) for _ in some]
        assert [data for data, _ in back] == some
        for data, sender in back:
            target.sendto(data[::-1], sender)
        assert receive(client, len(some)) == [data[::-1] for data in some]


def test_every_client_gets_its_own_answers(ends, arena):
    target = ends.port()
    proxy = ends.proxy(target)
    clients = [ends.client(proxy) for _ in range(5)]
    for number in range(40):
        for name, client in enumerate(clients):
            client.send(bytes([name, number]))
    heard = [target.recvfrom(65536) for _ in range(200)]
    assert len({sender for _, sender in heard}) == 5
    for data, sender in heard:
        target.sendto(b"re:" + data, sender)
    for name, client in enumerate(clients):
        assert receive(client, 40) == [b"re:" + bytes([name, number]) for number in range(40)]
    assert {item["received"] for item in proxy.summary()["clients"]} == {40}


def flood(ends, rules, seed, bursts, count=1200):
    """Send numbered commands in bursts; return the numbers that arrive, and the proxy."""
    target = ends.port()
    proxy = ends.proxy(target, rules=rules, seed=seed)
    client = ends.client(proxy)
    arrived = []

    def came(so_far):
        arrived.extend(arrived_at(target))
        return proxy.to_target[0].received == so_far

    for number, datagram in enumerate(numbered(count)):
        if number % bursts == 0:
            time.sleep(0.002)
        client.send(datagram)
        if number % 300 == 299 or number == count - 1:  # as many as every system's buffers hold
            until(lambda so_far=number + 1: came(so_far))
    proxy.end()
    arrived += arrived_at(target)
    return [int.from_bytes(data[8:12], "big") for data in arrived], proxy


def test_a_seed_drops_exactly_the_same_datagrams_in_every_run(ends):
    runs = [flood(ends, ["drop:0.1"], 7, bursts) for bursts in every(2, (3, 1, 60, 300))]
    first, proxy = runs[0]
    assert all(arrived == first for arrived, _ in runs)
    assert 60 < 1200 - len(first) < 180
    assert proxy.machine.struck == [1200 - len(first)]
    assert proxy.lost == 0  # on purpose is not by accident
    assert flood(ends, ["drop:0.1"], 8, 60)[0] != first


def test_what_faults_make_keeps_its_place_among_what_they_leave_alone(ends, arena):
    arrived, _ = flood(ends, ["duplicate:1,every=5,copies=3", "drop:1,every=4"], 1, 100, 400)
    assert arrived == [
        number for number in range(400) if number % 4 != 3 for _ in range(4 if number % 5 == 4 else 1)
    ]


def test_several_targets_each_get_everything(ends):
    stations = [ends.port() for _ in range(3)]
    proxy = ends.proxy(*stations, link=TO)
    client = ends.client(proxy)
    for datagram in numbered(100):
        client.send(datagram)
    assert all(receive(station, 100) == numbered(100) for station in stations)
    (known,) = proxy.clients
    stations[2].sendto(b"answer", known.sockets[2].getsockname())
    assert client.recv(99) == b"answer"


def test_two_ground_stations_receive_the_same_telemetry_through_one_to(ends):
    """TO itself sends to one address only."""
    stations = [ends.port(), ends.port()]
    ports = free_ports(3)
    fast = 25 * MILLISECOND
    profile = SimProfile(
        ci_port=ports[0],
        to_port=ports[1],
        sbn_port=ports[2],
        sbn_peers=(),
        ci_wake_ns=fast,
        to_wake_ns=fast,
        housekeeping_ns=fast,
    )
    proxy = ends.proxy(*stations, link=TO, listen=Endpoint(HOST, ports[1]))
    with Served(Simulation(profile, "rover", bridges=False)):
        enable = cfe.emit_command(0x1880, 6, HOST.encode().ljust(16, b"\0"))
        ends.port().sendto(enable, (HOST, ports[0]))
        first, second = (receive(item, 60) for item in stations)
    assert first == second
    assert {packet[:2].hex() for packet in first} >= {"0800", "0803", "0827", "0880"}
    assert proxy.lost == 0


def test_a_delay_takes_its_time_one_way(ends):
    target = ends.port()
    proxy = ends.proxy(target, rules=["delay:80ms,to=cfs"])
    client = ends.client(proxy)
    began = time.monotonic()
    client.send(b"late")
    data, sender = target.recvfrom(99)
    assert data == b"late"
    assert time.monotonic() - began > 0.079
    target.sendto(b"at once", sender)
    assert client.recv(99) == b"at once"


def test_what_is_held_back_at_the_end_is_told(ends):
    target = ends.port()
    proxy = ends.proxy(target, rules=["delay:1h"])
    ends.client(proxy).send(b"never")
    until(lambda: proxy.summary()["held"] == 1)
    proxy.end()
    assert (proxy.summary()["held"], proxy.lost, arrived_at(target)) == (1, 0, [])


def test_limits_of_a_topic_of_every_msg_id_and_of_all():
    mission = Mission((Route("/cmd_vel", "geometry_msgs/msg/Twist", 0x1827, CI, "command"),))
    cases = {
        "30": "rate:30",
        "/cmd_vel=30": "rate:30,msg_id=0x1827",
        "0x1828=5,latest": "rate:5,keep=latest,msg_id=0x1828",
        "all=100": "rate:100,per=link",
    }
    assert {text: limit_rule(text, mission).text for text in cases} == cases
    with pytest.raises(ConfigError, match=r"--max-rate x: hz 'x': a rate is needed.*; write 30"):
        limit_rule("x", mission)


def test_a_limit_lets_the_first_through_and_others_alone(ends):
    target = ends.port()
    client = ends.client(ends.proxy(target, rules=["rate:0.01,msg_id=0x1827"]))
    for datagram in numbered(20):
        client.send(datagram)
    client.send(cfe.emit_command(0x1828, 1))
    assert [data[1] for data in eventually(target, 2)] == [0x27, 0x28]


def test_a_filter_expression_chooses_what_is_struck(ends, arena):
    mission = Mission((Route("/cmd_vel", "geometry_msgs/msg/Twist", 0x1827, CI, "command"),))
    types = TypeStore()
    context = Context(mission, types)
    bench = Workbench(mission, types, ColumnDecoder(context))
    target = ends.port()
    client = ends.client(ends.proxy(target, rules=["drop:1,where=linear.x > 1"], where=compiler(bench)))
    for x in range(8):
        cdr = types.encode("geometry_msgs/msg/Twist", {"linear": {"x": x / 2}})
        client.send(cfe.emit_command(0x1827, 1, envelope.DEFAULT.emit(cdr)))
    assert len(eventually(target, 3)) == 3


def test_a_peer_that_speaks_to_a_port_of_its_table_finds_whoever_spoke_last(ends):
    """As SBN: cFS sends to the port in its table, never to where it was spoken to from."""
    cfs, (own,) = ends.port(), free_ports(1)
    proxy = ends.proxy(cfs, link=SBN, bind=Endpoint(HOST, own))
    cfs.sendto(b"to nobody yet", (HOST, own))
    until(lambda: proxy.to_client.unclaimed == 1)
    for _ in range(2):  # the second is the same bridge, started again
        bridge = ends.client(proxy)
        bridge.send(b"SUB")
        assert cfs.recvfrom(99) == (b"SUB", (HOST, own))
        cfs.sendto(b"PROTO", (HOST, own))
        assert bridge.recv(99) == b"PROTO"
    assert len(proxy.clients) == 1


def test_a_client_may_be_named_before_it_has_spoken(ends):
    cfs, bridge, (own,) = ends.port(), ends.port(), free_ports(1)
    ends.proxy(cfs, link=SBN, bind=Endpoint(HOST, own), client=Endpoint(*bridge.getsockname()))
    cfs.sendto(b"first", (HOST, own))
    assert bridge.recv(99) == b"first"


def test_clients_are_forgotten_when_there_are_too_many(ends):
    target = ends.port()
    proxy = ends.proxy(target, clients=2)
    for name in range(3):
        ends.client(proxy).send(bytes([name]))
        target.recv(9)
    assert (len(proxy.clients), proxy.summary()["clients_evicted"]) == (2, 1)


def test_clients_are_forgotten_when_idle(ends):
    target = ends.port()
    proxy = ends.proxy(target, idle_ns=50 * MILLISECOND)
    ends.client(proxy).send(b"once")
    assert target.recv(9) == b"once"
    until(lambda: not len(proxy.clients))
    ends.client(proxy).send(b"again")
    assert target.recv(9) == b"again"


def test_a_target_that_nobody_listens_on_is_told_and_lost_is_nothing(ends):
    target = ends.port(*free_ports(1))
    proxy = ends.proxy(target)
    client = ends.client(proxy)
    address = target.getsockname()
    target.close()

    def refused():
        client.send(b"x")
        return proxy.to_target[0].refused >= 4

    until(refused)
    again = ends.port(address[1])
    client.send(b"y")
    while (data := again.recv(9)) != b"y":
        assert data == b"x"  # on its way as the port was opened
    assert proxy.lost == 0


def test_what_a_full_socket_does_not_take_waits_and_what_is_over_is_counted(ends):
    target = ends.port()
    proxy = ends.proxy(target, queue_bytes=4 * 20)
    client = ends.client(proxy)
    client.send(b"first")
    assert target.recv(9) == b"first"
    (known,) = proxy.clients
    (outlet,) = known.to_target
    real, proxy._buffer.send = proxy._buffer.send, lambda *_: SendResult(0, full=True)
    flush, outlet.flush = outlet.flush, lambda: None
    for datagram in numbered(7):
        client.send(datagram)
    until(lambda: proxy.to_target[0].queued + proxy.to_target[0].overflowed == 7)
    assert (proxy.to_target[0].queued, proxy.to_target[0].overflowed) == (4, 3)
    outlet.flush, proxy._buffer.send = flush, real
    assert eventually(target, 4) == numbered(4)
    assert proxy.lost == 3
    assert proxy.to_target[0].queued == 0


def test_keys_switch_faults_and_end_the_run(ends, monkeypatch):
    reader, writer = os.pipe()
    monkeypatch.setattr("sys.stdin", os.fdopen(reader, closefd=False))
    target = ends.port()
    proxy = ends.proxy(target, rules=["drop:1,switch=off"], keys=Keys())
    client = ends.client(proxy)
    for expected in (1, 0, 1):
        client.send(b"x")
        assert len(eventually(target, expected)) == expected
        before = proxy.machine.enabled[0]
        os.write(writer, b"1x9")
        until(lambda before=before: proxy.machine.enabled[0] is not before)
    os.write(writer, b"Q")
    until(lambda: proxy._stopping)
    os.close(writer)
    os.close(reader)


def test_a_port_in_use_is_told_and_nothing_stays_open(ends, tmp_path):
    taken, target = ends.port(), ends.port()
    plan = ProxyPlan(CI, Endpoint(*taken.getsockname()), (Endpoint(*target.getsockname()),))
    with pytest.raises(CaptureError, match=r"--listen .*: another program has port"):
        Proxy(plan)
    with pytest.raises(CaptureError, match=r"--bind .*: another program has port"):
        Proxy(replace(plan, listen=ANY, bind=Endpoint(*taken.getsockname())))
    with pytest.raises(CaptureError, match=r"--target 255\.255\.255\.255:9: cannot be sent to"):
        Proxy(replace(plan, listen=ANY, targets=(Endpoint("255.255.255.255", 9),)))
    assert not list(tmp_path.iterdir())


PLANS = {
    "--target is missing": {"targets": ()},
    "--bind can only be used with one target": {
        "bind": ANY,
        "targets": (Endpoint(HOST, 1), Endpoint(HOST, 2)),
    },
    "--client needs --bind": {"client": ANY},
    "in a loop": {"listen": Endpoint(HOST, 1)},
}


@pytest.mark.parametrize("message", PLANS)
def test_a_plan_that_cannot_work_is_told(message):
    usual = {"link": CI, "listen": Endpoint(HOST, 9), "targets": (Endpoint(HOST, 1),)}
    with pytest.raises(ConfigError, match=message):
        ProxyPlan(**usual | PLANS[message])


@pytest.mark.parametrize("link", [CI, TO, SBN])
@pytest.mark.parametrize("end", ["target", "further", "bind", "client"])
def test_whoever_would_hear_itself_is_refused(link, end):
    wildcard, itself, other = Endpoint("0.0.0.0", 7), Endpoint(HOST, 7), Endpoint(HOST, 1)
    ends = {
        "target": {"listen": wildcard, "targets": (itself,)},
        "further": {"listen": wildcard, "targets": (other, itself)},
        "bind": {"listen": other, "bind": wildcard, "targets": (itself,)},
        "client": {"listen": wildcard, "bind": Endpoint(HOST, 8), "client": itself, "targets": (other,)},
    }
    option = "client" if end == "client" else "target"
    with pytest.raises(ConfigError, match=rf"--{option} 127\.0\.0\.1:7 is --.* itself: .* in a loop"):
        ProxyPlan(link=link, **ends[end])


@pytest.mark.parametrize(
    ("upkeep_ns", "fault_ns", "since_ns", "wait_ms"),
    [
        (20 * MILLISECOND, None, SECOND, 20),
        (1, None, SECOND, 1),  # rather late than polled without sleep
        (-1, None, SECOND, 0),
        (20 * MILLISECOND, 3_900_000, SECOND, 3),  # the rest is polled, for the moment of a fault
        (20 * MILLISECOND, 900_000, SECOND, 0),
        (1, 3_900_000, SECOND, 1),
        (20 * MILLISECOND, None, 19_000, 0),  # a datagram has just come
    ],
)
def test_how_long_it_sleeps(upkeep_ns, fault_ns, since_ns, wait_ms, monkeypatch):
    proxy = Proxy(ProxyPlan(CI, ANY, (Endpoint(HOST, 9),)))
    now, waits = 10 * SECOND, []
    monkeypatch.setattr(proxy, "_now", lambda: now)
    monkeypatch.setattr(proxy, "_active_ns", now - since_ns)
    monkeypatch.setattr(proxy, "machine", SimpleNamespace(next_ns=fault_ns and now + fault_ns))
    monkeypatch.setattr(proxy, "_upkeep_ns", now + SECOND)
    monkeypatch.setattr(proxy, "_poll", SimpleNamespace(poll=lambda wait: waits.append(wait) or ()))
    proxy._turn(now, now + upkeep_ns, None)
    assert waits == [wait_ms]
    monkeypatch.undo()
    proxy.close()
