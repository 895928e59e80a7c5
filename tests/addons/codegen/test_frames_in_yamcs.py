"""Yamcs as the judge of transfer frames: it takes the same packets out of TM and AOS frames as we do."""

import base64
import socket
from contextlib import closing, suppress

import pytest
from places import MISSIONS
from rewriting import Udp, write
from transfer_frames import GROUND, Maker, space_packet
from waiting import HOST, free_ports, until
from yamcs_server import HERE, WHY, api, asked, yamcs

from edoras_tools.addons.codegen.writing import describe_packets
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.bare import TO
from edoras_tools.pipelines.reading import reading
from edoras_tools.pipelines.workbench import Settings

INSTANCE = """
services:
  - {{class: org.yamcs.archive.XtceTmRecorder}}
  - {{class: org.yamcs.ProcessorCreatorService, args: {{name: realtime, type: realtime}}}}
dataLinks:
{links}
mdb: [{{type: xtce, spec: {folder}/rover.xml}}]
streamConfig:
  tm: [{{name: tm_realtime, processor: realtime}}]
  tc: [{{name: tc_realtime, processor: realtime}}]
  event: [events_realtime]
  param: [pp_realtime]
  cmdHist: [cmdhist_realtime]
"""
LINK = """
  - name: {name}
    class: org.yamcs.tctm.ccsds.UdpTmFrameLink
    port: {port}
    frameType: {kind}
    spacecraftId: 42
    frameLength: {length}
    frameHeaderErrorControlPresent: false
    insertZoneLength: {insert}
    errorDetection: {check}
    virtualChannels:
      - vcId: 1
        ocfPresent: {ocf}
        service: PACKET
        maxPacketLength: 4096
        stripEncapsulationHeader: false
        packetPreprocessorClassName: org.yamcs.tctm.GenericPacketPreprocessor
        packetPreprocessorArgs: {{timestampOffset: -1, seqCountOffset: 2}}
        stream: tm_realtime
"""
MAKERS = {
    "AOS": [
        Maker("aos", 40),
        Maker("aos", 300, insert=b"zone", ocf=True),
        Maker("aos", 64, fecf=False),
    ],
    "TM": [Maker("tm", 40), Maker("tm", 300, ocf=True, fecf=False)],
}


def ours(path, folder, maker):
    """Return the packets that we take out of a capture of the frames."""
    told = ", ".join(
        f"{name}: {str(value).lower()}" for name, value in {"port": GROUND[1], **maker.format()}.items()
    )
    (folder / "frames.yaml").write_text(f"link: {{ros__parameters: {{frames: {{down: {{{told}}}}}}}}}")
    bench, found = Settings([folder / "frames.yaml"]).workbench(), []
    with closing(open_file(path)) as source, reading(source, bench) as loop:
        for rows in loop:
            found += [
                rows.batch[row].payload for row in range(len(rows.batch)) if rows.columns.link[row] == TO
            ]
    return found


@pytest.mark.long
@pytest.mark.skipif(not HERE, reason=WHY)
def test_yamcs_takes_the_same_packets_out_of_frames_of_which_some_are_lost(tmp_path):
    (tmp_path / "rover.xml").write_bytes(
        describe_packets(Settings([MISSIONS / "rover_ground.yaml"]).workbench()).text
    )
    makers = [(kind, maker) for kind, items in MAKERS.items() for maker in items]
    http, *ports = free_ports(1 + len(makers))
    links = "".join(
        LINK.format(
            name=f"link{port}",
            port=port,
            kind=kind,
            length=maker.length,
            insert=len(maker.insert),
            check="CRC16" if maker.fecf else "NONE",
            ocf=str(maker.ocf).lower(),
        )
        for port, (kind, maker) in zip(ports, makers, strict=True)
    )
    expected = []
    with yamcs(tmp_path, http, INSTANCE.format(links=links, folder=tmp_path)):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            for index, (port, (_, maker)) in enumerate(zip(ports, makers, strict=True)):
                # Its archive knows a packet by its time and count: each count comes once.
                packets = [
                    space_packet(0x27, bytes([number]) * (5 + 37 * number), 100 * index + number)
                    for number in range(16)
                ]
                frames = [frame for frame, _ in maker.carry(packets)]
                kept = [frame for number, frame in enumerate(frames) if number not in {3, len(frames) // 2}]
                wrong = kept[-2][:-1] + bytes([kept[-2][-1] ^ 1]) if maker.fecf else kept[-2]
                kept[-2] = wrong
                for frame in kept:
                    sender.sendto(frame, (HOST, port))
                items = [Udp(10**6 * at, ("10.0.0.2", 40000), GROUND, frame) for at, frame in enumerate(kept)]
                taken = ours(write(tmp_path / f"{index}.pcap", items), tmp_path, maker)
                assert 6 < len(taken) < len(packets)
                assert set(taken) < set(packets)
                expected += taken

        def archived():
            with suppress(OSError, KeyError):
                told = asked(f"{api(http)}/archive/edoras/packets?limit=1000")["packet"]
                return sorted(base64.b64decode(item["packet"]) for item in told)
            return None

        until(lambda: len(archived() or []) >= len(expected), "the packets in Yamcs's archive")
        assert archived() == sorted(expected)


@pytest.mark.long
@pytest.mark.skipif(not HERE, reason=WHY)
@pytest.mark.parametrize("kind", ["AOS", "TM"])
def test_yamcs_takes_every_packet_out_of_the_frames_that_replay_makes(kind, call, tmp_path):
    (tmp_path / "rover.xml").write_bytes(
        describe_packets(Settings([MISSIONS / "rover_ground.yaml"]).workbench()).text
    )
    packets = [
        space_packet(0x27, bytes([number % 256]) * (5 + number % 300), number) for number in range(600)
    ]
    items = [
        Udp(10**7 * at, ("127.0.0.1", 40000), ("127.0.0.1", 1235), packet)
        for at, packet in enumerate(packets)
    ]
    capture = write(tmp_path / "packets.pcap", items)
    http, port = free_ports(2)
    form = {"port": port, "kind": kind.lower(), "length": 220, "ocf": kind == "AOS", "fecf": True}
    told = ", ".join(f"{name}: {str(value).lower()}" for name, value in form.items())
    mission = tmp_path / "frames.yaml"
    mission.write_text(f"link: {{ros__parameters: {{frames: {{down: {{{told}}}}}}}}}")
    link = LINK.format(
        name="down", port=port, kind=kind, length=220, insert=0, check="CRC16", ocf=str(kind == "AOS").lower()
    )
    link = link.replace("spacecraftId: 42", "spacecraftId: 66").replace("vcId: 1", "vcId: 0")
    with yamcs(tmp_path, http, INSTANCE.format(links=link, folder=tmp_path)):
        done = call("replay", capture, "--to", "frames", "-c", mission, "-q")
        assert done.code == 0, done.err

        def archived():
            with suppress(OSError, KeyError):
                told = asked(f"{api(http)}/archive/edoras/packets?limit=1000")["packet"]
                return sorted(base64.b64decode(item["packet"]) for item in told)
            return None

        until(lambda: len(archived() or []) >= len(packets), "the packets in Yamcs's archive")
        assert archived() == sorted(packets)
