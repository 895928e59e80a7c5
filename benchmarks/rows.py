"""What each command costs beside its peer, in alternation: at low rates, at high ones, for one message.

Called by run.py; alone: python benchmarks/rows.py [NAME ...]
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import hostile
import proxy
from paths import EDORAS, HERE, MISSION, TWO_ROVERS, captured, compiled
from rosbags.typesys import Stores, get_typestore
from rounds import ROUNDS, absent, alternated, busy_ns, command, running, summed_up

from edoras_tools.ros import TypeStore

if TYPE_CHECKING:
    from collections.abc import Callable

PORT = 47334
RATES, MANY = (20, 100, 1000, 5000), (50_000,)
RELAYED = (1_000, 1), (10_000, 1), (50_000, 1), (50_000, 50)
"""Datagrams a second, and how many of them are sent at once."""
SETTLE_S = 2.0


def texts(folder: Path) -> dict[str, object]:
    """The list and the JSON of 50,000 packets, start-up included, beside tshark's of a fifth of them."""
    many, fewer = captured(folder, 50_000), captured(folder, 10_000)

    def each(packets: int, arguments: list[object]) -> dict[str, float]:
        return {name[:-2] + "_us": value / packets * 1e6 for name, value in command(arguments).items()}

    return alternated(
        {
            "list": partial(each, 50_000, [EDORAS, "sniff", "-r", many, *TWO_ROVERS]),
            "tshark list": partial(each, 10_000, ["tshark", "-r", fewer]),
            "json": partial(each, 50_000, [EDORAS, "sniff", "--json", "-r", many, *TWO_ROVERS]),
            "tshark json": partial(each, 10_000, ["tshark", "-r", fewer, "-T", "ek"]),
        }
    )


def tcp(folder: Path, packets: int) -> dict[str, object]:
    """Record with 30 % of the frames SBN over TCP, beside record without; one process, so CPU time tells."""
    ways = {
        name: partial(
            command,
            [
                *[EDORAS, "record", "-q", "--force", "--jobs", "1", "-r", captured(folder, packets, share)],
                *[*TWO_ROVERS, "-o", folder / "tcp.mcap"],
            ],
        )
        for name, share in {"without": 0, "30 % TCP": 30}.items()
    }
    return {"packets": packets, **alternated(ways)}


def sbn(folder: Path) -> dict[str, object]:
    """Record with nine frames of ten of SBN, beside the mixed traffic; CPU a packet."""
    packets = 500_000
    plain, network = captured(folder, packets), folder / "sbn.pcap"
    subprocess.run([sys.executable, HERE / "make_capture.py", network, str(packets), "--sbn"], check=True)
    record = [EDORAS, "record", "-q", "--force", "--jobs", "1", *TWO_ROVERS, "-o", folder / "sbn.mcap", "-r"]

    def one(path: Path) -> dict[str, float]:
        return {"cpu_us": command([*record, path])["cpu_s"] / packets * 1e6}

    return {"packets": packets, **alternated({"mixed": partial(one, plain), "SBN": partial(one, network)})}


def starts(folder: Path) -> dict[str, object]:
    """What it costs to start: commands on a capture of one packet, beside Python alone and with numpy."""
    one, out = captured(folder, 1), folder / "one.mcap"
    ways = {
        "python": [sys.executable, "-c", "pass"],
        "numpy": [sys.executable, "-c", "import numpy"],
        "version": [EDORAS, "--version"],
        "help": [EDORAS, "-h"],
        "info": [EDORAS, "info", one],
        "sniff": [EDORAS, "sniff", one],
        "record": [EDORAS, "record", "-q", "--force", one, "-o", out],
    }
    return alternated({name: partial(command, arguments) for name, arguments in ways.items()})


def images(folder: Path) -> dict[str, object]:
    """The doctor on 300,000 images of 1.3 kB, beside as many packets of the mixed traffic."""
    packets, path = 300_000, folder / "images.pcap"
    hostile.write(path, hostile.KINDS["images"](packets))
    examine = [EDORAS, "doctor", "--json", *TWO_ROVERS]
    ways = {"mixed": captured(folder, packets), "images": path}
    found = alternated({name: partial(command, [*examine, capture]) for name, capture in ways.items()})
    return {"packets": packets, **found}


SUMMARY = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    print(make_reader(file).get_summary().statistics.message_count)
"""


def counts(folder: Path, packets: int) -> dict[str, object]:
    """What info answers of a finished recording, beside the library's summary."""
    capture, target = captured(folder, packets), folder / "counts.mcap"
    subprocess.run([EDORAS, "record", "-q", "--force", capture, *TWO_ROVERS, "-o", target], check=False)
    ways = {
        "info": [EDORAS, "info", "--json", target, *TWO_ROVERS],
        "mcap library": [sys.executable, "-W", "ignore", "-c", SUMMARY, target],
    }
    found = alternated({name: partial(command, arguments) for name, arguments in ways.items()})
    return {"packets": packets, **found}


def doctor(folder: Path, packets: int) -> dict[str, object]:
    """Doctor and report beside info."""
    capture = captured(folder, packets)
    report = [EDORAS, "report", "--force", "-q", "-r", capture, *TWO_ROVERS, "-o", folder / "report.html"]
    ways = {
        "doctor": [EDORAS, "doctor", "--json", "-r", capture, *TWO_ROVERS],
        "report": report,
        "info": [EDORAS, "info", "--json", "-r", capture, *TWO_ROVERS],
    }
    found = alternated({name: partial(command, arguments) for name, arguments in ways.items()})
    return {"packets": packets, **found}


WINDOW = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    reader = make_reader(file)
    start = reader.get_summary().statistics.message_start_time + int(sys.argv[2]) * 10**9
    second = {"start_time": start, "end_time": start + 10**9}
    print(sum(1 for _ in reader.iter_messages(["/edoras/datagrams"], **second)))
"""
"""Counts the datagrams of a second by the library."""


def window(folder: Path, packets: int) -> dict[str, object]:
    """One second out of a recording, beside the same by the mcap library and all of it; 10,000 a second."""
    capture, target, second = captured(folder, packets), folder / "window.mcap", str(packets // 12_000)
    subprocess.run([EDORAS, "record", "-q", "--force", capture, *TWO_ROVERS, "-o", target], check=False)
    part = ["--start", second, "--end", str(int(second) + 1)]
    ways = {
        "info": [EDORAS, "info", "--json", target, *TWO_ROVERS, *part],
        "ten packets": [EDORAS, "sniff", "--json", target, *TWO_ROVERS, *part[:2], "-n", "10"],
        "mcap library": [sys.executable, "-W", "ignore", "-c", WINDOW, target, second],
        "all": [EDORAS, "info", "--json", target, *TWO_ROVERS],
    }
    found = alternated({name: partial(command, arguments) for name, arguments in ways.items()})
    return {"packets": packets, **found}


TOPIC = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as file:
    print(sum(1 for _ in make_reader(file).iter_messages([sys.argv[2]])))
"""
"""Counts the messages of a topic by the library."""
RARE = "/cfs/CFE_SB_StatsTlm"


def topic(folder: Path, packets: int) -> dict[str, object]:
    """A rare topic out of a recording, beside the same by the mcap library."""
    capture, target, out = captured(folder, packets), folder / "topic.mcap", folder / "topic.csv"
    subprocess.run([EDORAS, "record", "-q", "--force", capture, *TWO_ROVERS, "-o", target], check=False)
    ways = {
        "export": [EDORAS, "export", "-q", "--force", target, "--topic", RARE, "-o", out],
        "ten packets": [EDORAS, "sniff", "--json", target, "--topic", RARE, "-n", "10"],
        "mcap library": [sys.executable, "-W", "ignore", "-c", TOPIC, target, RARE],
    }
    found = alternated({name: partial(command, arguments) for name, arguments in ways.items()})
    return {"packets": packets, **found}


def growth(folder: Path) -> dict[str, object]:
    """The doctor on captures that are hard on it, CPU: 1,000 of a kind and 4,000, boots 20 and 80."""
    found: dict[str, object] = {}
    kinds = "sources", "telemetry_sources", "sbn_sources", "strangers", "msg_ids", "pairs", "overload"
    for kind in (*kinds, "boots"):
        for number in (20, 80) if kind == "boots" else (1_000, 4_000):
            path = folder / f"{kind}.pcap"
            hostile.write(path, hostile.KINDS[kind](number))
            run = partial(command, [EDORAS, "doctor", "--json", path, *TWO_ROVERS])
            found[f"{kind}, {number:,}"] = summed_up({"cpu_s": [run()["cpu_s"] for _ in range(3)]})
    return found


def files(folder: Path) -> dict[str, object]:
    """Record with 30 % CFDP, whose files are messages, beside the same traffic without: CPU a packet."""
    packets = 300_000
    plain, mixed = captured(folder, packets), folder / "cfdp.pcap"
    subprocess.run(
        [sys.executable, HERE / "make_capture.py", mixed, str(packets), "--cfdp", "30"], check=True
    )
    transfer = folder / "transfer.yaml"
    scan = '{type: "sensor_msgs/msg/LaserScan", topic: "/scan", store_filename: "scan"}'
    transfer.write_text(f"/**: {{ros__parameters: {{write_data: [scan], scan: {scan}}}}}")
    target = folder / "files.mcap"

    def one(path: Path) -> dict[str, float]:
        target.unlink(missing_ok=True)
        told = command([EDORAS, "record", "-q", "-r", path, *TWO_ROVERS, "-c", transfer, "-o", target])
        return {"cpu_us": told["cpu_s"] / packets * 1e6}

    return alternated({"without": partial(one, plain), "30 % CFDP": partial(one, mixed)})


def messages() -> dict[str, object]:
    """One message decoded, us of CPU: beside rosbags, and beside a copy of its bytes."""
    store, peer = TypeStore(), get_typestore(Stores.ROS2_JAZZY)
    octets, seven = bytes(range(256)) * 128, [0.1 * number for number in range(7)]
    fields = [{"name": name, "offset": 4 * at, "datatype": 7, "count": 1} for at, name in enumerate("xyzi")]
    cases = {
        "sensor_msgs/msg/PointCloud2": {"width": 2048, "height": 1, "fields": fields, "data": octets},
        "sensor_msgs/msg/Image": {"width": 256, "height": 128, "encoding": "mono8", "data": octets},
        "sensor_msgs/msg/JointState": {"name": [f"joint_{n}" for n in range(7)], "position": seven},
        "nav_msgs/msg/Odometry": {},
    }

    def timed(run: Callable[[], object]) -> dict[str, float]:
        began = time.thread_time_ns()
        for _ in range(200):
            run()
        return {"cpu_us": (time.thread_time_ns() - began) / 200e3}

    found: dict[str, object] = {}
    for name, values in cases.items():
        cdr = store.encode(name, values)
        ways = {
            "edoras": partial(store.decode, name, cdr),
            "rosbags": partial(peer.deserialize_cdr, cdr, name),
            "copy": partial(bytearray, cdr),
        }
        found[name] = alternated({way: partial(timed, run) for way, run in ways.items()})
    return found


def inject(folder: Path) -> dict[str, object]:
    """One message: time to its datagram and to the command's return, beside tcpreplay's of one packet."""
    one = folder / "one.pcap"
    subprocess.run([sys.executable, HERE / "make_capture.py", one, "1"], check=True)

    def ours(*options: str) -> dict[str, float]:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
            receiver.bind(("127.0.0.1", 0))
            receiver.settimeout(30)
            target = f"127.0.0.1:{receiver.getsockname()[1]}"
            arguments = [EDORAS, "inject", "/cmd_vel", "{}", "-c", str(MISSION), "--target", target, *options]
            began = time.perf_counter()
            process = subprocess.Popen(arguments, stderr=subprocess.DEVNULL)
            receiver.recv(2048)
            first = time.perf_counter() - began
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            back = time.perf_counter() - began
            return {"first_s": first, "return_s": back, "cpu_s": used.ru_utime + used.ru_stime}

    ways: dict[str, Callable[[], dict[str, float]]] = {"no answers": partial(ours, "--no-listen")}
    ways["waits for answers"] = partial(ours, "--listen", f"127.0.0.1:{PORT + 1}")
    if shutil.which("tcpreplay"):
        ways["tcpreplay"] = partial(command, ["tcpreplay", "-q", "-i", "lo", one])
    return alternated(ways) | absent("tcpreplay")


def relays(folder: Path) -> dict[str, object]:
    """Latency through the proxy and a relay in C, us: what each adds to the direct way, and the whole."""
    relay = folder / "relay"
    compiled = shutil.which("cc")
    if compiled:
        subprocess.run(["cc", "-O2", HERE / "relay.c", "-o", relay], check=True)

    def through(rate: int, at_once: int, *options: str, **how: object) -> dict[str, float]:
        told = proxy.through(["stamped", rate, 1, at_once], *options, **how)
        sent, received = told["sent"]["sent"], told["received"]
        return {
            "p50_us": received["p50_us"],
            "p99_us": received["p99_us"],
            "cpu_us": told["busy_s"] / sent * 1e6,
            "lost": sent - received["received"],
        }

    found: dict[str, object] = {}
    for rate, at_once in RELAYED:
        ways = {"direct": partial(through, rate, at_once, direct=True)}
        ways["edoras"] = partial(through, rate, at_once)
        if compiled:
            by = [str(relay), str(proxy.LISTEN), str(proxy.TARGET)]
            ways["C relay"] = partial(through, rate, at_once, by=by)
        if rate == RELAYED[-1][0]:
            recording = ["--force", "-o", str(folder / "relayed.mcap")]
            ways["edoras recording"] = partial(through, rate, at_once, *recording)
        found[f"{rate}/s, {at_once} at once"] = with_added(alternated(ways))
    return found | ({} if compiled else {"C relay": "no C compiler"})


def with_added(found: dict[str, dict[str, list[float]]]) -> dict[str, object]:
    """Say first what each way adds to the direct one: least to least, median to median."""
    for name in found.keys() - {"rounds", "direct"}:
        added = {}
        for key in ("p50_us", "p99_us"):
            pairs = zip(found[name][key], found["direct"][key], strict=True)
            added[f"added_{key}"] = [round(whole - direct, 1) for whole, direct in pairs]
        found[name] = {**added, **found[name]}
    return found


def programs(folder: Path) -> dict[str, list[object]]:
    """Return what takes datagrams to the port, each into a file of its own."""
    rule = f"udp port {PORT}"
    record = [EDORAS, "record", "--force", "--port", f"ci:{PORT}", "-c", str(MISSION)]
    found: dict[str, list[object]] = {
        "record --listen": [*record, "--listen", f"127.0.0.1:{PORT}", "-o", folder / "listen.mcap"],
        "record -i": [*record, "-i", "lo", "-o", folder / "capture.mcap"],
        "sniff -i": [EDORAS, "sniff", "-i", "lo", "--port", f"ci:{PORT}", "-c", str(MISSION)],
        "dumpcap": ["dumpcap", "-q", "-i", "lo", "-f", rule, "-w", folder / "dumpcap.pcapng"],
        "tcpdump": ["tcpdump", "-i", "lo", "-w", folder / "tcpdump.pcap", rule],
    }
    return {name: arguments for name, arguments in found.items() if shutil.which(str(arguments[0]))}


def shares(folder: Path) -> dict[str, object]:
    """Share of a core, in percent, that each program takes of the same datagrams, in windows of a second."""
    every = programs(folder)
    recorders = {name: arguments for name, arguments in every.items() if name != "sniff -i"}
    return shares_of(every, RATES) | shares_of(recorders, MANY) | absent("dumpcap", "tcpdump")


def shares_of(every: dict[str, list[object]], rates: tuple[int, ...]) -> dict[str, object]:
    """Run some programs beside each other at some rates."""
    found: dict[str, object] = {}
    with ExitStack() as stack:
        pids = {name: stack.enter_context(running(arguments)).pid for name, arguments in every.items()}
        time.sleep(SETTLE_S)
        for rate in rates:
            sender = proxy.role("stamped", PORT, rate, ROUNDS + 1, max(1, rate // 1000))
            windows: dict[str, dict[str, list[float]]] = {name: {"percent": []} for name in pids}
            time.sleep(0.5)
            for _ in range(ROUNDS):
                before, began = {name: busy_ns(pid) for name, pid in pids.items()}, time.monotonic_ns()
                time.sleep(1)
                span = time.monotonic_ns() - began
                for name, pid in pids.items():
                    windows[name]["percent"].append((busy_ns(pid) - before[name]) / span * 100)
            sender.communicate()
            found[f"{rate}/s"] = {name: summed_up(figures) for name, figures in windows.items()}
    return found


def highest(folder: Path) -> dict[str, object]:
    """What record --listen loses as the rate rises, to the first loss."""
    found: dict[str, object] = {}
    for rate in (50_000, 100_000, 150_000, 200_000, 250_000):
        with running(programs(folder)["record --listen"]) as process:
            time.sleep(SETTLE_S)
            before = busy_ns(process.pid)
            sent = json.loads(proxy.role("stamped", PORT, rate, 3, rate // 1000).communicate()[0])["sent"]
            time.sleep(SETTLE_S / 2)
            cpu_us = (busy_ns(process.pid) - before) / sent / 1000
        told = subprocess.run(
            [EDORAS, "info", "--json", folder / "listen.mcap"], capture_output=True, check=False
        )
        lost = sent - json.loads(told.stdout)["datagrams"]
        found[f"{rate}/s"] = {"sent": sent, "lost": lost, "cpu_us": round(cpu_us, 2)}
        if lost:
            break
    return found


def measure(folder: Path, packets: int) -> dict[str, Callable[[], dict[str, object]]]:
    """Return the measurements by name; so many packets are examined by the doctor."""
    return {
        "texts": partial(texts, folder),
        "tcp": partial(tcp, folder, packets),
        "sbn": partial(sbn, folder),
        "starts": partial(starts, folder),
        "doctor": partial(doctor, folder, packets),
        "images": partial(images, folder),
        "counts": partial(counts, folder, 3 * packets),
        "window": partial(window, folder, 3 * packets),
        "topic": partial(topic, folder, 3 * packets),
        "growth": partial(growth, folder),
        "files": partial(files, folder),
        "messages": messages,
        "inject": partial(inject, folder),
        "relays": partial(relays, folder),
        "shares": partial(shares, folder),
        "highest": partial(highest, folder),
    }


def main() -> None:
    """Measure what is named, or everything."""
    compiled()
    with tempfile.TemporaryDirectory() as name:
        for key, run in measure(Path(name), 1_000_000).items():
            if not sys.argv[1:] or key in sys.argv[1:]:
                print(key, json.dumps(run(), indent=1), flush=True)


if __name__ == "__main__":
    main()
