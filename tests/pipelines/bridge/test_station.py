"""Messages from many threads to one, which sleeps until they come."""

from __future__ import annotations

import select
import threading

import pytest

from edoras_tools.pipelines.bridge import run as bridge_inbox
from edoras_tools.pipelines.bridge.run import Inbox


@pytest.fixture
def inbox():
    made = Inbox()
    yield made
    made.close()


def readable(inbox):
    return bool(select.select([inbox.fileno()], [], [], 0)[0])


def test_the_first_message_wakes_up_and_all_of_them_are_taken_in_order(inbox):
    assert not readable(inbox)
    first, second = inbox.slot(0, 3), inbox.slot(1, 0)
    first(b"a")
    second(b"b")
    first(b"c")
    assert readable(inbox)
    inbox.reset_signal()
    assert not readable(inbox)
    assert [(item.station, item.route, item.cdr) for item in inbox.take(2)] == [(0, 3, b"a"), (1, 0, b"b")]
    assert len(inbox) == 1
    assert [item.cdr for item in inbox.take(9)] == [b"c"]
    first(b"d")
    assert readable(inbox)


def test_none_is_missed_though_it_comes_while_others_are_taken(inbox):
    count, threads = 5000, 4
    slots = [inbox.slot(0, number) for number in range(threads)]

    def put(slot):
        for number in range(count):
            slot(str(number).encode())

    workers = [threading.Thread(target=put, args=(slot,)) for slot in slots]
    for worker in workers:
        worker.start()
    found = [[] for _ in slots]
    while sum(map(len, found)) < count * threads:
        assert select.select([inbox.fileno()], [], [], 30)[0]
        inbox.reset_signal()
        while messages := inbox.take(64):
            for item in messages:
                found[item.route].append(int(item.cdr))
    for worker in workers:
        worker.join()
    assert found == [list(range(count))] * threads


def test_what_comes_while_it_is_quieted_is_taken_and_the_next_rings_again(inbox, monkeypatch):
    slot = inbox.slot(0, 0)
    read = bridge_inbox.os.eventfd_read

    def reading(fileno):
        slot(b"before")
        value = read(fileno)
        slot(b"after")
        return value

    slot(b"first")
    monkeypatch.setattr(bridge_inbox.os, "eventfd_read", reading)
    inbox.reset_signal()
    assert [item.cdr for item in inbox.take(9)] == [b"first", b"before", b"after"]
    slot(b"next")
    assert readable(inbox)


def test_what_is_too_much_is_counted(inbox, monkeypatch):
    monkeypatch.setattr(bridge_inbox, "_MOST_WAITING", 3)
    slot = inbox.slot(0, 0)
    for _ in range(5):
        slot(b"")
    assert (len(inbox), inbox.overflowed) == (3, 2)


def test_it_can_be_rung_and_be_empty(inbox):
    inbox.ring()
    assert readable(inbox)
    inbox.reset_signal()
    assert inbox.take(9) == []


def test_after_closing_it_is_dead_to_all(inbox):
    slot = inbox.slot(0, 0)
    inbox.close()
    inbox.ring()
    slot(b"late")
