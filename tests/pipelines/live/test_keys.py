from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.io.foxglove.playback import PlaybackRequest, PlaybackState
from edoras_tools.pipelines.live.keys import request_of, split_keys

SECOND = 1_000_000_000
NOW = PlaybackState("Playing", 60 * SECOND, 2.0)
START = 50 * SECOND


@pytest.mark.parametrize(
    ("key", "request_"),
    [
        (" ", PlaybackRequest(playing=False, speed=2.0)),
        ("\x1b[c", PlaybackRequest(playing=True, speed=2.0, seek_ns=65 * SECOND)),
        ("\x1bod", PlaybackRequest(playing=True, speed=2.0, seek_ns=55 * SECOND)),
        ("\x1b[a", PlaybackRequest(playing=True, speed=4.0)),
        ("-", PlaybackRequest(playing=True, speed=1.0)),
        ("\x1b[1~", PlaybackRequest(playing=True, speed=2.0, seek_ns=START)),
        ("x", None),
        ("q", None),
        ("\x1b[5~", None),
    ],
)
def test_what_a_key_asks_for(key, request_):
    assert request_of(key, NOW, START) == request_
    assert list(split_keys(f"{key} {key}")) == [key, " ", key]


def test_nothing_is_before_the_start():
    early = PlaybackState("Paused", START + SECOND, 1.0)
    assert request_of("\x1b[d", early, START) == PlaybackRequest(playing=False, speed=1.0, seek_ns=START)
    assert request_of(" ", early, START).playing


@given(st.text(max_size=30))
def test_nothing_that_is_typed_is_lost(text):
    assert "".join(split_keys(text)) == text
