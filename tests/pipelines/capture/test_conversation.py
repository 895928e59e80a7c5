"""Conversations: who is named how, and which packets make one run."""

from itertools import pairwise

import numpy as np
from effort import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from places import ROOT

from edoras_tools.decode.filters.rows import ColumnRows
from edoras_tools.links.sbn import SBN
from edoras_tools.pipelines.capture.conversation import Conversation, Statistics
from edoras_tools.pipelines.reading import selected_rows
from edoras_tools.pipelines.selection import Selection
from edoras_tools.pipelines.workbench import Settings, open_files

SECOND = 10**9


def whole(name, *missions, where=""):
    bench = Settings([ROOT / f"samples/missions/{item}.yaml" for item in missions]).workbench()
    source = open_files([ROOT / f"samples/captures/{name}.pcap"])
    (rows,) = selected_rows(source, bench, selection=Selection(where=where))
    return bench, rows


def said(rows):
    conversation = Conversation(rows.context)
    conversation.add(rows)
    return conversation.messages()


def test_the_rover_from_the_ground():
    _, rows = whole("a_rover", "rover_ground", where="link != other")
    messages = said(rows)
    assert sum(item.count for item in messages) == len(rows)
    told = {(item.source, item.destination, item.label): item.count for item in messages}
    assert told["Ground 127.0.0.1", "CI 127.0.0.1:1234", "0x1827 /cmd_vel"] == 600
    assert told["Ground 127.0.0.1", "CI 127.0.0.1:1234", "0x1880 TO_CMD ENABLE_OUTPUT"] == 1
    assert told["TO 127.0.0.1", "Ground 127.0.0.1", "0x0827 /telemetry_pose"] == 63
    assert told["SBN 66:1", "127.0.0.1:2236", "SUB"] == 36
    assert len(told) == len(messages), "nothing pauses in this capture"
    times = [item.first_ns for item in messages]
    assert times == sorted(times)
    assert times[0] == 0


def test_peers_go_by_their_identity_once_it_is_known():
    _, rows = whole("f_sbn_disconnect", where="link == sbn")
    parties = {name for item in said(rows) for name in (item.source, item.destination)}
    assert parties == {"SBN 66:1", "SBN 66:3", "SBN 66:9", "127.0.0.1:2235"}


def test_what_is_wrong_is_kept_with_its_run():
    _, rows = whole("f_sbn_disconnect", where="link == sbn")
    wrong = {item.label: set(item.findings) for item in said(rows) if item.findings}
    assert wrong["type 0x07"] == {"sbn_unknown_type"}
    assert "truncated" in wrong["unreadable"]


def at_times(times):
    """Return one like packet at each of these times."""
    bench, rows = whole("a_rover", where="link == sbn")
    first = np.zeros(len(times), np.int64) + rows.indices()[0]
    batch = replace(rows.batch.take(first), time_ns=np.array(times, np.int64))
    return ColumnRows(bench.columns.context, 0, batch, rows.columns.take(first))


def test_runs_end_at_pauses():
    regular = [step * SECOND // 2 for step in range(20)]
    later = [60 * SECOND + time for time in regular]
    messages = said(at_times(regular + later))
    assert [(item.count, item.first_ns) for item in messages] == [(20, 0), (20, 60 * SECOND)]
    assert messages[0].period_ns == SECOND / 2


def test_what_comes_seldom_but_evenly_is_one_run():
    (message,) = said(at_times([11 * SECOND * step for step in range(9)]))
    assert message.count == 9
    assert message.period_ns == 11 * SECOND


def test_one_missed_packet_ends_no_run():
    times = [step * SECOND for step in range(20) if step != 7]
    assert [item.count for item in said(at_times(times))] == [19]


@settings(max_examples=examples(25, 4))
@given(cuts=st.lists(st.integers(0, 998), max_size=6))
def test_however_the_batches_are_cut_the_conversation_is_the_same(cuts):
    bench, rows = CUT
    expected = said(rows)
    conversation = Conversation(bench.columns.context)
    bounds = sorted({0, len(rows), *(min(cut, len(rows)) for cut in cuts)})
    for low, high in pairwise(bounds):
        conversation.add(rows.take(np.arange(low, high)))
    assert conversation.messages() == expected


CUT = whole("f_sbn_disconnect", where="link == sbn")


def test_statistics_count_every_packet_once():
    bench, rows = whole("f_sbn_disconnect")
    counted = Statistics(bench)
    half = len(rows) // 2
    for part in (np.arange(half), np.arange(half, len(rows))):
        counted.add(rows.take(part))
    network = counted.table("sbn")
    assert sum(row["count"] for row in network) == np.count_nonzero(rows.column("link") == SBN)
    beats = next(row for row in network if row["message"] == "HEARTBEAT" and row["source"] == "SBN 66:3")
    assert (beats["destination"], beats["count"], beats["runs"]) == ("SBN 66:1", 7, 2)
    assert 8000 < beats["period_ms"] < 10000
    sizes = counted.table("sizes")
    assert sum(row["count"] for row in sizes) == len(rows)
    assert sum(row["bytes"] for row in sizes) == int(rows.datagram("length").sum())
    assert [row["bytes"] for row in sizes] == sorted((row["bytes"] for row in sizes), reverse=True)
    assert counted.table("findings")["sbn_version_mismatch"] == 1
    assert sum(row["count"] for row in counted.table("routes")) == len(rows)


def test_statistics_without_sbn():
    bench, rows = whole("a_rover", where="link == ci")
    counted = Statistics(bench)
    counted.add(rows)
    assert counted.table("sbn") == []
