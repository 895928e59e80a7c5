"""Yamcs itself: it loads our XTCE, receives a sample's telemetry from ``replay``, and sends a command."""

import socket
import time
from contextlib import suppress

import pytest
from ground_packets import DRIVE, WORD, drive_payload, struct_bench
from places import CAPTURES, ROOT
from rewriting import datagrams
from waiting import HOST, PATIENCE_S, Program, free_ports, until
from yamcs_server import HERE, WHY, api, asked, yamcs

from edoras_tools.addons.codegen.writing import describe_packets
from edoras_tools.pipelines.sending.replay import Encoder
from edoras_tools.wire import cfe

INSTANCE = """
services:
  - {{class: org.yamcs.archive.XtceTmRecorder}}
  - {{class: org.yamcs.ProcessorCreatorService, args: {{name: realtime, type: realtime}}}}
dataLinks:
  - name: to
    class: org.yamcs.tctm.UdpTmDataLink
    stream: tm_realtime
    port: {telemetry}
    packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
    packetPreprocessorArgs: {{timestampOffset: -1, seqCountOffset: 2}}
  - {{name: ci, class: org.yamcs.tctm.UdpTcDataLink, stream: tc_realtime, host: 127.0.0.1, port: {commands}}}
mdb: [{{type: xtce, spec: {folder}/rover.xml}}]
streamConfig:
  tm: [{{name: tm_realtime, processor: realtime}}]
  tc: [{{name: tc_realtime, processor: realtime}}]
  event: [events_realtime]
  param: [pp_realtime]
  cmdHist: [cmdhist_realtime]
"""


@pytest.mark.long
@pytest.mark.skipif(not HERE, reason=WHY)
def test_yamcs_reads_and_sends_what_we_do(tmp_path):
    http, telemetry = free_ports(2)
    bench = struct_bench(tmp_path, "big")
    made = describe_packets(bench)
    (tmp_path / "rover.xml").write_bytes(made.text)
    realtime = f"{api(http)}/processors/edoras/realtime"
    poses = [item.payload for item in datagrams(CAPTURES / "a_rover.pcap") if item.payload[:2] == b"\x08\x27"]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ci:
        ci.bind((HOST, 0))
        ci.settimeout(PATIENCE_S)
        ports = {"telemetry": telemetry, "commands": ci.getsockname()[1], "folder": tmp_path}
        with yamcs(tmp_path, http, INSTANCE.format(**ports)):

            def value(name):
                with suppress(OSError, KeyError):
                    found = asked(f"{realtime}/parameters/edoras/telemetry_pose_{name}")["engValue"]
                    return next(item for key, item in found.items() if key != "type")
                return None

            last = bench.types.decode("geometry_msgs/msg/PoseStamped", poses[-1][32:])

            def shown():
                return value("header_stamp_nanosec") == last["header"]["stamp"]["nanosec"]

            def replayed():
                """Its port holds little: what came while it was busy is lost, and comes again."""
                replay(telemetry)
                end = time.monotonic() + 5
                while not shown() and time.monotonic() < end:
                    time.sleep(0.05)
                return shown()

            until(replayed)
            assert value("header_frame_id_6") == last["header"]["frame_id"] == "world"
            assert [value(f"pose_position_{axis}") for axis in "xyz"] == list(
                last["pose"]["position"].values()
            )
            asked(
                f"{realtime}/commands/edoras/cmd_vel",
                {"args": {**dict.fromkeys(ARGUMENTS, 0), "linear_x": 0.5}},
            )
            (route,) = (item for item in bench.mission.routes if item.topic == "/cmd_vel")
            cdr = bench.types.encode(route.type, {"linear": {"x": 0.5}})
            assert ci.recv(2000) == Encoder.of(route, bench).packet(cdr, 0).packet
            chosen = DRIVE | {"mode": "DRIVING", "word": WORD.hex()}
            asked(f"{realtime}/commands/edoras/Drive_0x1890_3", {"args": chosen})
            drive = cfe.emit_command(0x1890, 3, drive_payload("big"), sequence_flags=0, with_checksum=False)
            assert ci.recv(2000) == drive
            asked(f"{realtime}/commands/edoras/Reset", {})
            assert ci.recv(2000).hex() == "1891000000010000"


ARGUMENTS = [f"{part}_{axis}" for part in ("linear", "angular") for axis in "xyz"]


def replay(port):
    words = ("replay", CAPTURES / "a_rover.pcap", "--to", "ground", "--target", f"{HOST}:{port}")
    with Program(ROOT / ".venv/bin/edoras", *words, "--speed", "50", "--no-listen", "-q") as program:
        assert program.process.wait(PATIENCE_S) == 0
