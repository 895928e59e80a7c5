"""What CI's own count shows of what was sent: the rules at the top of the file under test, as transcripts."""

from __future__ import annotations

import pytest

from edoras_tools.pipelines.sending.ingest import IngestCount


def account(*steps):
    """Follow steps: ``begin``, ``("sent", n)`` or the count of a report."""
    ingest = IngestCount()
    for step in steps:
        if step == "begin":
            ingest.begin()
        elif isinstance(step, tuple):
            ingest.sent = step[1]
        else:
            ingest.reported(step)
    return ingest


@pytest.mark.parametrize(
    ("steps", "state", "read", "missing", "final"),
    [
        # known before: exact
        ([7, "begin", ("sent", 5), 12], "all", 5, 0, True),
        ([7, "begin", ("sent", 5), 9], "waiting", 2, None, False),
        ([7, "begin", ("sent", 5), 9, 9], "waiting", 2, None, False),
        ([7, "begin", ("sent", 5), 9, 9, 9], "missing", 2, 3, True),
        ([7, "begin", ("sent", 5), 9, 9, 11, 12], "all", 5, 0, True),
        ([7, "begin", ("sent", 5)], "unknown", None, None, False),
        ([7, "begin", ("sent", 5), 30], "others", None, None, True),
        # a report that stood still while more was sent is none that repeats the last
        ([7, "begin", ("sent", 5), 9, ("sent", 9), 9, 9], "waiting", 2, None, False),
        # asked for telemetry first: known once the count stands still, and what asked is not part of it
        ([("sent", 1), 8, 8, "begin", ("sent", 4), 11], "all", 3, 0, True),
        ([("sent", 1), 7, 8, 8, "begin", ("sent", 4), 10, 10, 10], "missing", 2, 1, True),
        ([("sent", 1), 8, "begin", ("sent", 4), 10, 10, 10], "partly", 2, None, True),
        # first heard after the beginning
        (["begin", ("sent", 3), 50, ("sent", 9), 55, 55, 55], "partly", 5, None, True),
        (["begin", ("sent", 1), 50, 51], "all", 1, 0, True),
        (["begin", ("sent", 1), 50, 50, 50], "unknown", None, None, True),
        (["begin", ("sent", 1)], "unknown", None, None, False),
        # a count that falls
        ([7, "begin", ("sent", 5), 9, 2, 3], "restarted", None, None, False),
        ([7, 3, "begin", ("sent", 5), 8], "all", 5, 0, True),
    ],
)
def test_what_a_count_shows(steps, state, read, missing, final):
    ingest = account(*steps)
    summary = ingest.summary()
    assert (summary["state"], summary["read"], summary["missing"]) == (state, read, missing)
    assert ingest.is_final == final


def test_known_exactly_before_anything_is_sent_or_once_it_stands_still():
    assert not account().is_known
    assert account(7).is_known
    assert not account(("sent", 2), 9).is_known
    assert not account(("sent", 2), 8, 9).is_known
    assert account(("sent", 2), 8, 9, 9).is_known


def test_only_what_is_proved_counts_as_missing():
    assert account(7, "begin", ("sent", 5), 9).missing == 0
    assert account(7, "begin", ("sent", 5), 9, 9, 9).missing == 3
    assert account("begin", ("sent", 5), 9, 9, 9).missing == 0
    assert account().missing == 0
