"""What the doctor says of real captures, held to what was done when they were made."""

import re

import pytest

FIRST = {"d3_cpu1_cpu2": 1795242236.191145, "f_sbn_disconnect": 1795241927.192459}
"""Epoch seconds of the first packet, for the marks' times."""


def found(diagnosis, rule):
    return [item for item in diagnosis.verdicts if item.rule == rule]


@pytest.mark.parametrize("missions", [(), ("rover_ground",)])
def test_a_rover_lost_92_of_600_at_the_applications_pipe(capture, missions):
    diagnosis = capture("a_rover", *missions)
    (verdict,) = found(diagnosis, "app_pipe_limit")
    assert (verdict.lost, verdict.of, verdict.msg_id, verdict.hop) == (92, 600, 0x1827, "EDORAS_APP_PIPE")
    assert "it keeps 4 of one MsgId, and CI hands over a burst every 500 ms" in verdict.reason
    assert "every 500 ms: 8 a second get through" in verdict.reason
    assert any("sent at 10.0 Hz" in line for line in verdict.evidence)
    assert any("stops this event after 16" in line for line in verdict.evidence)
    assert diagnosis.lost == 92
    assert verdict.topic == ("/cmd_vel" if missions else None)
    (telemetry,) = [row for row in diagnosis.routes if row["msg_id"] == "0x0827"]
    assert (telemetry["seen"], telemetry["lost"], telemetry["gaps"]) == (63, 0, 0)


@pytest.mark.parametrize("missions", [(), ("single_arm_ground",)])
def test_b_arm_lost_nothing_and_what_is_older_is_said_to_be(capture, missions):
    diagnosis = capture("b_arm_single", *missions)
    assert diagnosis.lost == 0
    assert [item.rule for item in diagnosis.verdicts] == ["older_losses"]
    assert diagnosis.verdicts[0].reason.startswith("10 losses")


STEPS = {
    9: 7,
    10: 15,
    12: 31,
    20: 95,
    30: 175,
    50: 334,
    100: 732,
    200: 1530,
    250: 1931,
    500: 3929,
    1000: 7927,
}


@pytest.mark.each(2)
@pytest.mark.parametrize("missions", [(), ("rover_ground",)])
def test_c1_names_the_loss_of_each_step_and_the_clean_rate(capture, missions):
    diagnosis = capture("c1_tlm_rate_limit4", *missions)
    verdicts = sorted(found(diagnosis, "to_message_limit"), key=lambda item: item.start_ns)
    assert [item.lost for item in verdicts] == list(STEPS.values())
    for rate, item in zip(STEPS, verdicts, strict=True):
        offered = item.of / ((item.end_ns - item.start_ns) / 1e9)
        assert offered == pytest.approx(rate, rel=0.05)
        assert ": 8 a second get through" in item.reason
        assert item.hop == "TO_LAB_TLM_PIPE"
    assert diagnosis.lost == sum(STEPS.values())


@pytest.mark.long
@pytest.mark.parametrize("missions", [(), ("two_rovers_ground", "two_rovers_flight")])
def test_d3_follows_both_peers_within_a_second(capture, missions):
    diagnosis = capture("d3_cpu1_cpu2", *missions)
    (cpu2,) = [row for row in diagnosis.peers if row["peer"] == "66:2"]
    states = [(row["state"], row["time_ns"] / 1e9) for row in cpu2["states"]]
    # Connects and time-outs as cpu1's console has them, kill and stop as they were done.
    truth = [
        ("connected", 1795242245.800302),
        ("silent", 1795242321.375096),
        ("timed_out", 1795242332.484308),
        ("connected", 1795242339.275077),
        ("silent", 1795242351.032640),
        ("timed_out", 1795242362.101408),
    ]
    assert [state for state, _ in states] == [state for state, _ in truth]
    for (_, told), (_, done) in zip(states, truth, strict=True):
        assert told == pytest.approx(done, abs=1)
    (cpu1,) = [row for row in diagnosis.peers if row["peer"] == "66:1"]
    assert [row["state"] for row in cpu1["states"]] == ["connected"]
    assert len(found(diagnosis, "cfs_restart")) == 1


@pytest.mark.long
def test_d3_interleaved_counts_of_two_processors_are_no_loss(capture):
    diagnosis = capture("d3_cpu1_cpu2")
    housekeeping = {"0x0800", "0x0801", "0x0803", "0x0804", "0x0805", "0x0880", "0x0884"}
    rows = [row for row in diagnosis.as_json()["balance"] if row["msg_id"] in housekeeping]
    assert {cause for row in rows for cause in row["lost_by"]} == {"sbn_timeout"}
    lost = sum(row["lost"] for row in diagnosis.routes if row["msg_id"] in housekeeping)
    assert lost == sum(row["lost"] for row in rows)


def test_d3_says_once_what_one_traffic_lost_at_one_place_in_one_time(capture):
    about = [
        (item.rule, item.msg_id, item.link, item.hop, item.span)
        for item in capture("d3_cpu1_cpu2").verdicts
        if item.lost
    ]
    assert len(about) == len(set(about)) > 10


def test_d3_names_the_peers_pipe_at_250_hz(capture):
    (verdict,) = found(capture("d3_cpu1_cpu2"), "sbn_peer_pipe")
    assert (verdict.msg_id, verdict.hop) == (0x828, "SBN_1_66_Pipe")
    assert "40 a second get through" in verdict.reason
    assert verdict.lost / verdict.of == pytest.approx(1 - 40 / 250, abs=0.03)


BAD_COMMANDS = {
    # What was sent, by its time in s: the rule that names it, and what cFS did.
    18.8: ("bad_command", "EDORAS_APP 2: Invalid ground command code: CC = 9"),
    21.4: ("bad_command", "EDORAS_APP 6: Invalid Msg length"),
    26.6: ("bad_command", "CI_LAB_APP 16: Invalid msg length"),
    29.2: ("bad_command", "CFE_ES 23: Invalid msg length"),
    31.8: ("bad_command", "TO_LAB_APP 9"),
    34.4: ("no_subscriber", "NoSubscribers grew"),
    37.0: ("bad_command", "CFE_SB 21: Send Err:Invalid MsgId(0x0)"),
    39.6: ("no_subscriber", "NoSubscribers grew"),
    42.2: ("bad_command", "Invalid MsgId(0x2827)"),
    44.8: ("bad_command", "Invalid MsgId(0xffff)"),
    47.4: ("bad_command", ""),
    50.0: ("bad_command", ""),
    52.6: ("bad_command", ""),
    55.2: ("bad_command", "bad length=7"),
    57.8: ("bad_command", "bad length=6"),
    60.4: ("bad_command", "bad length=1"),
    63.0: ("bad_command", ""),
    65.6: ("bad_command", ""),
    68.2: ("bad_command", ""),
    70.8: ("bad_command", "CFE_SB 15: Send Err:Msg Too Big"),
    73.4: ("bad_command", ""),
    78.6: ("ci_cut", "769 bytes"),
    81.2: ("ci_cut", "1,400 bytes"),
    83.8: ("bad_command", ""),
    11.0: ("bad_command", ""),
    13.6: ("bad_command", ""),
    94.2: ("to_destination", "enabled for IP 127."),
}


@pytest.mark.each(2)
@pytest.mark.parametrize("missions", [(), ("rover_ground",)])
def test_e_names_each_bad_datagram_and_what_cfs_did(capture, missions):
    diagnosis = capture("e_ci_errors", *missions)
    told = {
        (round((item.start_ns - diagnosis.start_ns) / 1e9, 1), item.rule): " ".join(item.evidence)
        for item in diagnosis.verdicts
    }
    for seconds, (rule, words) in BAD_COMMANDS.items():
        assert words in told[seconds, rule]
    # Good ones are not named: the first and the last command, the no-ops, the resets.
    good = {3.4, 6.0, 16.2, 24.0, 89.0, 96.8, 99.4, 119.8}
    assert not good & {round((item.start_ns - diagnosis.start_ns) / 1e9, 1) for item in diagnosis.verdicts}


BAD_NETWORK = {
    70.0: ("wrong_ident", "version number mismatch with peer CpuID 3"),
    72.0: ("wrong_protocol_version", "peer version 10"),
    74.0: ("bad_network_message", "unknown message type 0x00000007"),
    77.0: ("unknown_peer", "unknown peer 66:9"),
    79.0: ("bad_network_message", "unable to set msgid"),
    81.0: ("bad_network_message", ""),
    83.0: ("bad_network_message", "could not unpack message"),
    85.0: ("no_subscriber", "NoSubscribers grew"),
}


@pytest.mark.parametrize("missions", [(), ("two_rovers_ground", "two_rovers_flight")])
def test_f_names_each_malformed_datagram_and_the_silence(capture, missions):
    diagnosis = capture("f_sbn_disconnect", *missions)
    told = {
        (round((item.start_ns - diagnosis.start_ns) / 1e9), item.rule): " ".join(item.evidence)
        for item in diagnosis.verdicts
    }
    for seconds, (rule, words) in BAD_NETWORK.items():
        assert words in told[round(seconds), rule]
    (silence,) = found(diagnosis, "sbn_timeout")
    assert silence.lost == 24
    (row,) = diagnosis.peers
    states = [(item["state"], item["time_ns"] / 1e9) for item in row["states"]]
    truth = [
        ("connected", 1795241932.968241),
        ("silent", 1795241948.769604),
        ("timed_out", 1795241959.8),
        ("connected", 1795241964.570727),
        ("disconnected", 1795241989.173137),
        ("connected", 1795241992.174232),
    ]
    assert [state for state, _ in states] == [state for state, _ in truth]
    for (_, at), (_, done) in zip(states, truth, strict=True):
        assert at == pytest.approx(done, abs=1)


def test_what_came_once_is_told_in_the_singular(capture):
    diagnosis = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    texts = [text for item in diagnosis.verdicts for text in (item.reason, *item.evidence)]
    assert any(text.startswith("1 message on 0x18ee (SBN) carries an EDORAS envelope") for text in texts)
    assert any(text.startswith("1 PROTO of 66:3 names another protocol version") for text in texts)
    once = [text for text in texts if re.search(r"\b(?<![\d,.] )1 (messages|datagrams|commands)\b", text)]
    assert [text for text in once if " of 1 " not in text] == []


def test_f_gaps_while_nobody_subscribed_are_no_loss(capture):
    diagnosis = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    rows = [row for row in diagnosis.routes if row["msg_id"] == "0x082a"]
    (told,) = [row for row in diagnosis.as_json()["balance"] if row["msg_id"] == "0x082a" and row["lost"]]
    # Sent to a bridge that had been killed, until it was timed out: no gap shows it.
    assert told["lost_by"] == {"sbn_timeout": 24}
    assert [row["lost"] for row in rows] == [24]


def test_f_matches_states_across_cfs_and_names_the_comb(capture):
    diagnosis = capture("f_sbn_disconnect", "two_rovers_ground", "two_rovers_flight")
    (row,) = [row for row in diagnosis.routes if row["msg_id"] == "0x0828"]
    (crossing,) = row["crossings"]
    assert (crossing["from"], crossing["matched"], crossing["missing"]) == ("0x1829", 105, 0)
    assert crossing["latency"]["max_ms"] < 520
    assert row["comb_ms"] == pytest.approx(500, abs=5)


def test_d3_says_of_each_silence_what_was_sent_in_it(capture):
    silences = sorted(found(capture("d3_cpu1_cpu2"), "sbn_timeout"), key=lambda item: item.start_ns)
    assert [(item.lost, item.of) for item in silences] == [(284, 286), (292, 292)]  # it may have heard two
    for item in silences:
        seconds = (item.end_ns - item.start_ns) / 1e9
        # Until it is given up, 11 s later: cFS sends some 26 a second.
        assert item.of / seconds == pytest.approx(26.3, abs=1)


def test_f_garbage_is_no_overrun_where_the_malformed_packet_is_not_in_the_capture(lab):
    whole = lab.datagrams("f_sbn_disconnect")
    without = [item for item in whole if item.destination.port != 2234 and item.source.port != 2234]
    diagnosis = lab.examine(without, lab.missions("two-rovers"))
    (verdict,) = found(diagnosis, "struct_overrun")
    assert verdict.confidence == "medium"
    assert "is garbage: its envelope" in verdict.reason
    assert not any("overwritten" in line for line in verdict.evidence)
