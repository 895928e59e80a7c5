import pytest

from edoras_tools.addons.foxglove.cli import playback_line, served
from edoras_tools.addons.foxglove.server.protocol import PlaybackState


def client(**values):
    return {"address": "127.0.0.1:5", "sent": 0, "bytes": 0, "dropped": 0, "waiting": 0} | values


def summary(*clients, published=0, refused=0):
    total = {name: sum(item[name] for item in clients) for name in ("sent", "dropped")}
    return {
        "url": "",
        "connections": len(clients),
        "clients": clients,
        "published": published,
        "refused": refused,
        **total,
    }


def test_one_line_tells_it():
    assert list(served(summary())) == ["Foxglove: 0 clients, 0 messages sent"]
    assert list(served(summary(client(sent=1)))) == ["Foxglove: 1 client, 1 message sent"]


def test_what_clients_published_is_told_where_they_did():
    told = summary(client(sent=1234), published=5000, refused=2)
    assert list(served(told)) == ["Foxglove: 1 client, 1,234 messages sent, 5,000 taken from them, 2 refused"]


def test_who_was_too_slow_is_told():
    told = summary(client(sent=10), client(address="[::1]:6", sent=1, dropped=1000, waiting=4))
    assert list(served(told))[1:] == ["[::1]:6 was too slow for 1,000 of 1,005 messages"]


SECOND = 1_000_000_000


@pytest.mark.parametrize(
    ("state", "clients", "waiting", "line"),
    [
        (PlaybackState("Playing", 12_340_000_000, 2.0), 1, False, "playing 0:12.3 of 1:40.0, 2x, 1 client"),
        (PlaybackState("Paused", 100 * SECOND, 0.5), 0, False, "paused 1:40.0 of 1:40.0, 0.5x, 0 clients"),
        (PlaybackState("Playing", 0, 1.0), 0, True, "waits for a client at 0:00.0 of 1:40.0, 1x, 0 clients"),
    ],
)
def test_lines(state, clients, waiting, line):
    assert playback_line(state, (0, 100 * SECOND), clients, waiting=waiting) == line
