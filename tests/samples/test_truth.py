"""What was done to a running cFS, as its marks and its console tell, and the findings that must say so."""

from __future__ import annotations

import json
from functools import reduce
from operator import xor

import pytest
from effort import LONG
from places import SAMPLES

TRUTH = json.loads((SAMPLES / "expected/truth.json").read_text())
COMMAND_LENGTHS = {
    (0x1827, 0): {8},
    (0x1884, 0): {8},
    (0x1806, 0): {8},
    (0x1880, 6): {24, 28},
}
"""What the flight's own `Invalid Msg length` events and the public sources say, of the commands sent here."""


@pytest.fixture(scope="session")
def findings(make_expected):
    """Findings by capture and packet; of the packets in the table, or of all, by both decoders."""
    from edoras_tools.io.formats.open import open_file
    from edoras_tools.model import Finding
    from edoras_tools.pipelines.workbench import Settings

    found, named = {}, {(row["capture"], row["number"]) for row in TRUTH}
    for capture, missions in make_expected.MISSIONS.items():
        bench = Settings([SAMPLES / f"missions/{name}.yaml" for name in missions]).workbench()
        source = open_file(SAMPLES / f"captures/{capture}.pcap")
        for batch in source.batches():
            columns = bench.columns.decode(batch)
            for row, number in enumerate(batch.number.tolist()):
                finding = Finding(int(columns.findings[row]))
                if LONG or (capture, number) in named:
                    assert bench.dissector.dissect(batch[row]).findings == finding
                found[capture, number] = set(finding.labels)
        source.close()
    return found


@pytest.mark.each(3)
@pytest.mark.parametrize("row", TRUTH, ids=lambda row: f"{row['capture']}-{row['number']}")
def test_what_was_sent_has_the_findings_that_it_deserves(row, captures, findings):
    assert captures[row["capture"]][row["number"]].payload.hex().startswith(row["starts"])
    assert findings[row["capture"], row["number"]] == set(row["findings"])


def judge(payload):
    """Judge a datagram to CI of the rover demo by rules written out here, none of them the package's."""
    size = len(payload)
    if size < 6:
        return {"truncated"}
    word, sequence = int.from_bytes(payload[:2], "big"), payload[2:4]
    total = int.from_bytes(payload[4:6], "big") + 7
    command = bool(word & 0x1000)
    valid = 0 < word <= 0x1FFF
    named = {0x0827, 0x1827, *range(0x1801, 0x1807), 0x1880, 0x1884, 0x18FA}
    faults = {
        "length_mismatch": total != size,
        "sequence_unset": sequence == b"\0\0",
        "over_ci_buffer": size > 768,
        "over_software_bus": total > 32768,
        "invalid_msg_id": not valid,
        "unknown_msg_id": valid and word not in named,
        "wrong_direction": not command,
    }
    if command and size < 8:
        faults["truncated"] = True
    elif command:
        code, wrong = payload[6] & 0x7F, reduce(xor, payload[: min(size, total)], 0xFF) != 0
        faults["checksum_absent"] = wrong and payload[7] == 0
        faults["checksum_bad"] = wrong and payload[7] != 0
        lengths = COMMAND_LENGTHS.get((word, code))
        faults["command_length"] = lengths is not None and size not in lengths
        faults["unknown_function_code"] = (word, code) in {(0x1827, 9), (0x1880, 77)}
    if word in {0x0827, 0x1827} and size >= 8:
        body = payload[8 if command else 16 :]
        claimed, start = int.from_bytes(body[:8], "little"), body[16:]
        faults["truncated"] = not body and total != size
        faults["envelope_overrun"] = bool(body) and claimed > len(start)
        whole = bool(body) and claimed <= len(start)
        faults["cdr_invalid"] = whole and (claimed < 52 if command else claimed < 60)
        faults["cdr_big_endian"] = whole and claimed >= 4 and start[:2] == b"\0\0"
    return {name for name, there in faults.items() if there}


def test_every_command_of_the_bad_ones_is_judged_as_by_hand(captures, findings):
    commands = [
        packet for packet in captures["e_ci_errors"].values() if packet.destination == "127.0.0.1:1234"
    ]
    assert len(commands) == 47
    for packet in commands:
        assert findings["e_ci_errors", packet.number] == judge(packet.payload), packet.number


def test_all_that_is_bad_is_in_the_table(captures, findings):
    """Each warning and error has a reason, but for the app's own housekeeping, which no file names."""
    usual = {"checksum_absent", "sequence_unset", "stale_tail"}
    told = {(row["capture"], row["number"]) for row in TRUTH}
    for (capture, number), found in findings.items():
        if found - usual and (capture, number) not in told:
            assert (captures[capture][number].payload[:2], found) == (b"\x08\x26", {"unknown_msg_id"})


def test_the_eight_malformed_sbn_datagrams(findings):
    wanted = {
        1197: "sbn_id_mismatch",
        1227: "sbn_version_mismatch",
        1253: "sbn_unknown_type",
        1279: "sbn_no_message",
        1291: "sbn_id_mismatch",
        1321: "truncated",
        1347: "sbn_size_mismatch",
        1371: "sbn_size_mismatch",
    }
    for number, finding in wanted.items():
        assert finding in findings["f_sbn_disconnect", number]


def test_a_good_link_has_no_errors(findings):
    for (capture, _), found in findings.items():
        if capture in {"a_rover", "b_arm_single"}:
            assert found <= {"checksum_absent", "sequence_unset", "unknown_msg_id"}
