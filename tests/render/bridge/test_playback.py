from __future__ import annotations

import pytest

from edoras_tools.io.foxglove.playback import PlaybackState
from edoras_tools.render.bridge.playback import playback_line

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
