"""The node as an independent Zenoh session of another process sees it, over loopback TCP."""

import json
import socket
import subprocess
import sys
import threading
import time

import pytest
from places import SUPPORT
from waiting import PATIENCE_S, free_ports

from edoras_tools.addons.zenoh.graph import open_graph
from edoras_tools.addons.zenoh.identity import ATTACHMENT, GID, gid
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import Qos
from edoras_tools.middleware import graph as middleware_graph
from edoras_tools.ros import TypeStore

TWIST = "geometry_msgs/msg/Twist"
TWIST_KEY = (
    "geometry_msgs::msg::dds_::Twist_/RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a"
)
STRING = "std_msgs/msg/String"
STRING_KEY = (
    "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
)
JUDGE = SUPPORT / "zenoh_judge.py"
MARKER = b"the last one"


TRIES = 3
"""Somebody else may take a port that was found free."""


def free_port():
    return free_ports(1, socket.SOCK_STREAM)[0]


class Judge:
    """A plain Zenoh router: its observations, in order."""

    def __init__(self, port, until):
        self.port = port
        self.until = until
        self.seen = []
        self.process = subprocess.Popen(
            [sys.executable, str(JUDGE), str(port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.reader = threading.Thread(target=self._read)
        self.reader.start()

    def _read(self):
        self.seen.extend(json.loads(line) for line in self.process.stdout)

    def of(self, name):
        return [item for item in list(self.seen) if name in item]

    def ready(self):
        self.until(lambda: self.of("ready") or self.process.poll() is not None)
        return bool(self.of("ready"))

    def order(self, do, key, cdr=b"", attachment=b""):
        done = len(self.of("done"))
        order = {"do": do, "key": key, "cdr": cdr.hex(), "attachment": attachment.hex()}
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        self.until(lambda: len(self.of("done")) > done)

    def tokens(self):
        """The tokens that are alive."""
        alive = {}
        for item in self.of("token"):
            alive[item["token"]] = item["alive"]
        return {name for name, lives in alive.items() if lives}

    def samples(self, key):
        return [item for item in self.of("key") if item["key"] == key]

    def close(self):
        self.process.stdin.close()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        finally:
            self.reader.join()
            self.process.stdout.close()


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch):
    monkeypatch.delenv("ZENOH_SESSION_CONFIG_URI", raising=False)
    monkeypatch.delenv("ZENOH_CONFIG_OVERRIDE", raising=False)


@pytest.fixture(scope="module")
def jazzy():
    return TypeStore("jazzy")


@pytest.fixture
def judge(until):
    for _ in range(TRIES):
        judge = Judge(free_port(), until)
        if judge.ready():
            break
        judge.close()
    else:
        pytest.fail("the judge does not start; why is on standard error")
    yield judge
    judge.close()


@pytest.fixture
def graphs():
    """Open graphs that are closed when the test is over."""
    opened = []

    def open_one(store, port, node="bridge", domain=0, **options):
        options = {"router": f"tcp/127.0.0.1:{port}", "listen": "tcp/127.0.0.1:0"} | options
        opened.append(open_graph(store, node, domain=domain, options=options))
        return opened[-1]

    yield open_one
    for graph in opened:
        graph.close()


def test_the_graph_shows_the_node_and_all_it_has(judge, graphs, jazzy, until):
    graph = graphs(jazzy, judge.port, "/robot/bridge", domain=7)
    graph.advertise("/pose", TWIST, Qos())
    graph.subscribe("/robot/cmd_vel", TWIST, Qos(reliable=False, depth=1), print)
    graph.advertise("/map", STRING, Qos(transient_local=True, depth=1))
    until(lambda: len(judge.tokens()) == 4)
    session = next(iter(judge.tokens())).split("/")[2]
    assert judge.tokens() == {
        f"@ros2_lv/7/{session}/0/0/NN/%/%robot/bridge",
        f"@ros2_lv/7/{session}/0/1/MP/%/%robot/bridge/%pose/{TWIST_KEY}/::,10:,:,:,,",
        f"@ros2_lv/7/{session}/0/2/MS/%/%robot/bridge/%robot%cmd_vel/{TWIST_KEY}/2::,1:,:,:,,",
        f"@ros2_lv/7/{session}/0/3/MP/%/%robot/bridge/%map/{STRING_KEY}/:1:,1:,:,:,,",
    }
    graph.close()
    until(lambda: not judge.tokens())


def test_a_message_goes_out_under_its_key_with_its_attachment(judge, graphs, jazzy, until):
    cdr = jazzy.encode(TWIST, {"linear": {"x": 0.5}, "angular": {"z": -1.25}})
    publish = graphs(jazzy, judge.port).advertise("/robot/pose", TWIST, Qos())
    now = time.time_ns()
    for _ in range(3):
        publish(cdr)
    seen = until(lambda: len(found := judge.samples(f"0/robot/pose/{TWIST_KEY}")) == 3 and found)
    assert {item["cdr"] for item in seen} == {cdr.hex()}
    numbers, times, sizes, sources = zip(
        *(ATTACHMENT.unpack(bytes.fromhex(item["attachment"])) for item in seen), strict=True
    )
    assert numbers == (1, 2, 3)
    assert all(abs(item - now) < 3600 * 10**9 for item in times)
    token = until(lambda: next((item for item in judge.tokens() if "/MP/" in item), ""))
    assert ({*sizes}, {*sources}) == ({GID}, {gid(token)})


def test_what_is_missing_between_the_numbers_of_a_publisher_is_counted(judge, graphs, jazzy, until):
    heard = []
    graph = graphs(jazzy, judge.port)
    graph.subscribe("/text", STRING, Qos(None, None), heard.append)
    until(lambda: any("/MS/" in item for item in judge.tokens()))
    assert graph.states()["/text"].qos == (Qos(transient_local=True),)
    # Two publishers: of the first 4 and 5 are missing, 7 comes late; the second is not heard from its first.
    numbers = [(b"a", 2), (b"a", 3), (b"b", 9), (b"a", 6), (b"a", 8), (b"a", 7), (b"b", 10), (b"a", 9)]
    for source, number in numbers:
        attachment = ATTACHMENT.pack(number, 0, GID, source * 16)
        judge.order("put", f"0/text/{STRING_KEY}", source, attachment)
    until(lambda: len(heard) == len(numbers))
    assert graph.states()["/text"].missed == 2


@pytest.mark.each(3)
@pytest.mark.parametrize("attachment", [ATTACHMENT.pack(1, 2, GID, bytes(16)), b"", b"odd"])
@pytest.mark.parametrize("durable", [False, True])
def test_a_message_comes_in_byte_for_byte(judge, graphs, jazzy, until, attachment, durable):
    heard = []
    graphs(jazzy, judge.port).subscribe("/cmd_vel", TWIST, Qos(transient_local=durable), heard.append)
    until(lambda: any("/MS/" in item for item in judge.tokens()))
    cdr = jazzy.encode(TWIST, {"linear": {"x": 1.0}}, big_endian=True)
    judge.order("put", f"0/cmd_vel/{TWIST_KEY}", cdr, attachment)
    until(lambda: heard)
    assert heard == [cdr]


def test_other_domains_types_and_definitions_are_not_heard(judge, graphs, jazzy, until):
    heard = []
    graphs(jazzy, judge.port).subscribe("/cmd_vel", TWIST, Qos(), heard.append)
    until(lambda: any("/MS/" in item for item in judge.tokens()))
    name, digest = TWIST_KEY.split("/")
    judge.order("put", f"1/cmd_vel/{TWIST_KEY}", b"domain")
    judge.order("put", f"0/cmd_vel/{name}/RIHS01_{'0' * 64}", b"definition")
    judge.order("put", f"0/cmd_vel/{name}/TypeHashNotSupported", b"distribution")
    judge.order("put", f"0/cmd_vel/geometry_msgs::msg::dds_::Accel_/{digest}", b"type")
    judge.order("put", f"0/cmd_vel/{TWIST_KEY}", MARKER)
    until(lambda: heard)
    assert heard == [MARKER]


@pytest.mark.parametrize("durable", [False, True])
def test_a_node_never_hears_itself(judge, graphs, jazzy, until, durable):
    """Not even what its own cache answers its own late subscription: so another node must have had that."""
    qos = Qos(transient_local=durable)
    graph, other = graphs(jazzy, judge.port), graphs(jazzy, judge.port, "other")
    early, late, others = [], [], []
    graph.subscribe("/both", STRING, qos, early.append)
    publish = graph.advertise("/both", STRING, qos)
    publish(b"first")
    graph.subscribe("/both", STRING, qos, late.append)
    other.subscribe("/both", STRING, qos, others.append)
    until(lambda: len([item for item in judge.tokens() if "/MS/" in item]) == 3)
    if durable:
        until(lambda: others)
    publish(b"second")
    until(lambda: len(judge.samples(f"0/both/{STRING_KEY}")) == 2)
    judge.order("put", f"0/both/{STRING_KEY}", MARKER)
    until(lambda: MARKER in early and MARKER in late)
    assert early == late == [MARKER]


def test_late_subscribers_get_the_last_messages(judge, graphs, jazzy, until):
    qos = Qos(transient_local=True, depth=3)
    graph = graphs(jazzy, judge.port)
    publish = graph.advertise("/map", STRING, qos)
    for number in range(5):
        publish(b"%d" % number)
    until(lambda: len(judge.samples(f"0/map/{STRING_KEY}")) == 5)
    judge.order("late", f"0/map/{STRING_KEY}")
    until(lambda: len(judge.of("late")) == 3)
    assert [bytes.fromhex(item["late"]) for item in judge.of("late")] == [b"2", b"3", b"4"]


@pytest.mark.parametrize("lasting", [True, None])
def test_a_late_subscription_gets_the_last_messages(judge, graphs, jazzy, until, lasting):
    judge.order("keep", f"0/map/{STRING_KEY}")
    heard = []
    graphs(jazzy, judge.port).subscribe("/map", STRING, Qos(transient_local=lasting), heard.append)
    until(lambda: len(heard) == 3)
    assert heard == [b"2", b"3", b"4"]


@pytest.mark.each(3)
@pytest.mark.parametrize(
    ("distro", "options", "digest"),
    [
        ("humble", {}, "TypeHashNotSupported"),
        ("jazzy", {}, STRING_KEY.split("/")[1]),
        ("latest", {}, STRING_KEY.split("/")[1]),
        ("humble", {"type_hash": "rihs01"}, STRING_KEY.split("/")[1]),
        ("jazzy", {"type_hash": "none"}, "TypeHashNotSupported"),
    ],
)
def test_the_distribution_or_an_option_decides_over_hashes(judge, graphs, until, distro, options, digest):
    graph = graphs(TypeStore(distro), judge.port, **options)
    publish = graph.advertise("/chatter", STRING, Qos())
    key = f"0/chatter/std_msgs::msg::dds_::String_/{digest}"

    def heard():
        publish(b"text")  # what is said before the router knows who listens is lost
        return judge.samples(key)

    until(heard)
    until(lambda: any(f"/%chatter/std_msgs::msg::dds_::String_/{digest}/" in t for t in judge.tokens()))


def test_only_who_keeps_all_waits_for_slow_subscribers(judge, graphs, jazzy, until):
    graph = graphs(jazzy, judge.port)
    for name, qos in {"/all": Qos(depth=0), "/last": Qos(), "/best": Qos(reliable=False, depth=0)}.items():
        graph.advertise(name, STRING, qos)(b"x")
    until(lambda: len(judge.of("key")) == 3)
    blocks = {item["key"].split("/")[1]: item["blocks"] for item in judge.of("key")}
    assert blocks == {"all": True, "last": False, "best": False}


@pytest.mark.long
def test_thousands_of_messages_arrive_in_order_and_whole(judge, graphs, jazzy, until):
    heard = []
    other = graphs(jazzy, judge.port, "other", mode="client")  # peers change their way once they have met
    other.subscribe("/fast", STRING, Qos(), heard.append)
    publish = graphs(jazzy, judge.port, mode="client").advertise("/fast", STRING, Qos(depth=0))
    until(lambda: any("/MS/" in item for item in judge.tokens()))

    def reached():
        publish(b"hello")
        return heard

    until(reached)
    sent = [b"%d" % number for number in range(5000)]
    for cdr in sent:
        publish(cdr)
    until(lambda: heard[-1] == sent[-1])
    assert [item for item in heard if item != b"hello"] == sent


def test_a_router_may_come_later(graphs, jazzy, until):
    for _ in range(TRIES):
        port = free_port()
        graph = graphs(jazzy, port)
        assert not graph.connected
        publish = graph.advertise("/pose", TWIST, Qos())
        publish(b"to nobody")
        judge = Judge(port, until)
        if judge.ready():
            break
        judge.close()
    else:
        pytest.fail("the judge does not start; why is on standard error")
    try:
        until(lambda: graph.connected)
        until(lambda: any("/MP/" in item for item in judge.tokens()))
        publish(b"here")
        until(lambda: judge.samples(f"0/pose/{TWIST_KEY}"))
    finally:
        judge.close()


def test_an_error_of_publishing_is_one_line(judge, graphs, jazzy):
    graph = graphs(jazzy, judge.port)
    publish = graph.advertise("/pose", TWIST, Qos())
    for entity in graph._entities:
        entity.undeclare()
    with pytest.raises(ConfigError, match=r"^/pose: cannot be published on: [^\n]+$"):
        publish(b"x")
    graph._entities.clear()


def test_nothing_is_heard_once_closed(judge, graphs, jazzy, until):
    heard, going = [], threading.Event()
    before = set(threading.enumerate())
    graph = graphs(jazzy, judge.port)
    publish = graph.advertise("/pose", TWIST, Qos())

    def slow(cdr):
        going.set()
        time.sleep(0.05)
        heard.append(cdr)

    graph.subscribe("/cmd_vel", TWIST, Qos(), slow)
    until(lambda: any("/MS/" in item for item in judge.tokens()))
    for _ in range(20):
        judge.order("put", f"0/cmd_vel/{TWIST_KEY}", MARKER)
    assert going.wait(PATIENCE_S)
    graph.close()
    count = len(heard)
    assert count
    publish(b"ignored")
    graph.close()
    until(lambda: not judge.tokens())
    judge.order("put", f"0/cmd_vel/{TWIST_KEY}", MARKER)
    until(lambda: set(threading.enumerate()) <= before)  # who called back is gone, with all that waited
    assert len(heard) == count
    assert not judge.samples(f"0/pose/{TWIST_KEY}")


def test_the_environment_of_rmw_zenoh_is_obeyed(judge, graphs, jazzy, until, monkeypatch, tmp_path):
    file = tmp_path / "session.json5"
    file.write_text('{mode: "peer", scouting: {multicast: {enabled: false}}, listen: {endpoints: []}}')
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(file))
    monkeypatch.setenv(
        "ZENOH_CONFIG_OVERRIDE", f'mode="client";connect/endpoints=["tcp/127.0.0.1:{judge.port}"]'
    )
    graph = open_graph(jazzy, "bridge")
    try:
        assert graph.connected
        until(judge.tokens)
    finally:
        graph.close()


def test_a_file_takes_the_place_of_the_defaults_and_options_go_before(judge, jazzy, until, tmp_path):
    file = tmp_path / "session.json5"
    file.write_text(
        '{mode: "client", scouting: {multicast: {enabled: false}}, connect: {endpoints: ["tcp/127.0.0.1:1"]}}'
    )
    with pytest.raises(ConfigError, match=r"Unable to connect to any of .*tcp/127\.0\.0\.1:1"):
        open_graph(jazzy, "bridge", options={"config": str(file), "mode": "client"})
    options = {"config": str(file), "router": f"tcp/127.0.0.1:{judge.port}"}
    graph = open_graph(jazzy, "bridge", options=options)
    until(judge.tokens)
    graph.close()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rooter": "x"}, r"has no option 'rooter'; there are router, mode, listen, config, type_hash"),
        ({"mode": "router"}, "mode 'router' does not exist; write peer or client"),
        ({"type_hash": "md5"}, "type_hash 'md5' does not exist; write rihs01 or none"),
        ({"router": "nonsense"}, "router: connect/endpoints cannot be .*nonsense.*: Endpoints must be"),
        (
            {"config": "/no/such/file.json5"},
            "/no/such/file.json5: no configuration of a Zenoh session: No such",
        ),
    ],
)
def test_options_that_cannot_be_honoured(jazzy, options, words):
    with pytest.raises(ConfigError, match=words) as caught:
        open_graph(jazzy, "bridge", options=options)
    assert all("\n" not in line for line in caught.value.mistakes)


def test_a_node_with_nobody_to_talk_to_says_so_once(graphs, judge, jazzy, until, monkeypatch):
    monkeypatch.setattr("edoras_tools.addons.zenoh.graph._LONELY_S", 0.0)
    alone, met = graphs(jazzy, judge.port, router=""), graphs(jazzy, judge.port)
    (note,) = alone.notes()
    assert note.endswith("start a router: ros2 run rmw_zenoh_cpp rmw_zenohd")
    until(lambda: met.connected)
    assert alone.notes() == met.notes() == []


def test_places_that_cannot_be_had(jazzy):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        listen = {"listen": f"tcp/127.0.0.1:{port}", "router": ""}
        with pytest.raises(
            ConfigError, match=f"127.0.0.1:{port}.*Address already in use.*; listen somewhere"
        ):
            open_graph(jazzy, "bridge", options=listen)
    client = {"mode": "client", "router": "tcp/127.0.0.1:1"}
    with pytest.raises(ConfigError, match=r"Unable to connect.*start a router there: ros2 run rmw_zenoh_cpp"):
        open_graph(jazzy, "bridge", options=client)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0", "localhost"])
def test_nodes_of_one_process_listen_beside_each_other(host, graphs, jazzy, until):
    """Whoever comes to the place that was named meets them all."""
    port = free_port()
    listen = {"listen": f"tcp/{host}:{port}", "router": ""}
    nodes = [graphs(jazzy, port, name, **listen) for name in ("ground", "flight", "third")]
    heard = {node: [] for node in range(len(nodes))}
    said = []
    for number, node in enumerate(nodes):
        node.subscribe("/cmd_vel", TWIST, Qos(), heard[number].append)
    publish = [node.advertise(f"/pose_{number}", TWIST, Qos()) for number, node in enumerate(nodes)]
    other = graphs(jazzy, port, "other")
    for number in range(len(nodes)):
        other.subscribe(f"/pose_{number}", TWIST, Qos(), said.append)
    command = other.advertise("/cmd_vel", TWIST, Qos())

    def all_met():
        command(b"go")
        for number, speak in enumerate(publish):
            speak(bytes([number]))
        return all(heard.values()) and len(set(said)) == len(nodes)

    until(all_met)


def test_a_file_s_place_for_peers_is_shared_too(jazzy, until, tmp_path):
    file = tmp_path / "session.json5"
    file.write_text(
        "{scouting: {multicast: {enabled: false}}, timestamping: {enabled: true},"
        f' listen: {{endpoints: {{peer: ["tcp/127.0.0.1:{free_port()}"]}}}}}}'
    )
    first, second = (open_graph(jazzy, name, options={"config": str(file)}) for name in ("first", "second"))
    until(lambda: second.connected)
    second.close()
    first.close()


def test_a_place_is_free_again_when_its_node_has_gone(jazzy):
    port = free_port()
    place = {"listen": f"tcp/127.0.0.1:{port}", "router": ""}
    open_graph(jazzy, "first", options=place).close()
    second = open_graph(jazzy, "second", options=place)
    socket.create_connection(("127.0.0.1", port)).close()
    second.close()


def test_names_and_types_that_do_not_exist(graphs, jazzy):
    with pytest.raises(ConfigError, match="node '/my node' is not a ROS name"):
        open_graph(jazzy, "my node")
    with pytest.raises(ConfigError, match="domain -1 does not exist"):
        open_graph(jazzy, "bridge", domain=-1)
    graph = graphs(jazzy, 1, router="")
    for join in (graph.advertise, lambda *rest: graph.subscribe(*rest, print)):
        with pytest.raises(ConfigError, match="topic 'pose' is not a ROS name"):
            join("pose", TWIST, Qos())
        with pytest.raises(ConfigError, match="/pose: type 'geometry_msgs/msg/Twisted' is not known"):
            join("/pose", "geometry_msgs/msg/Twisted", Qos())


def test_without_the_library_one_line_names_the_extra(jazzy, monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    for name in ("config", "graph"):  # as in a process that has not joined a graph yet
        monkeypatch.delitem(sys.modules, f"edoras_tools.addons.zenoh.{name}", raising=False)
    with pytest.raises(ConfigError) as caught:
        middleware_graph.open_graph("zenoh", jazzy, "bridge")
    assert str(caught.value).startswith("--ros zenoh needs an extra (")
    assert str(caught.value).endswith("pip install 'edoras-tools[zenoh]'")
