from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.errors import ConfigError

FRIENDS = [
    "https://app.foxglove.dev",
    "https://studio.foxglove.dev",
    "HTTPS://APP.FOXGLOVE.DEV",
    "file://",
    "http://localhost",
    "http://localhost:8080",
    "http://viz.localhost:8080",
    "https://127.0.0.1:3000",
    "http://127.1.2.3",
    "http://[::1]:8080",
]
STRANGERS = [
    "https://evil.example",
    "http://app.foxglove.dev",
    "https://foxglove.dev.evil.example",
    "https://evilfoxglove.dev",
    "https://evil.example/.foxglove.dev",
    "https://localhost.evil.example",
    "http://127.0.0.1.evil.example",
    "http://localhost@evil.example",
    "http://evil.example@localhost",
    "chrome-extension://localhost",
    "http://10.0.0.5:8080",
    "http://[::1",
    "https://localhost#.example",
    "https://localhost?.example",
    "https://localhost\\.example",
    "http://2130706433",
    "file:///etc/passwd",
    "https://app.foxglove.dev, https://evil.example",
    "null",
    "",
]


@pytest.mark.parametrize("origin", FRIENDS)
def test_foxglove_and_this_machines_pages_come_in(origin):
    assert OriginCheck().admits(origin)


@pytest.mark.parametrize("origin", STRANGERS)
def test_all_others_are_kept_out(origin):
    assert not OriginCheck().admits(origin)
    assert not OriginCheck(("https://viz.example.org",)).admits(origin)


def test_who_is_named_comes_in():
    check = OriginCheck(("https://Viz.example.org", "http://*.lab:8080", "http://[fd00::1]:80"))
    assert check.admits("https://viz.example.org")
    assert check.admits("http://a.lab:8080")
    assert check.admits("http://[fd00::1]:80")
    assert check.admits("https://app.foxglove.dev")
    assert not check.admits("http://a.lab:8081")
    assert OriginCheck(("*",)).admits("null")
    assert OriginCheck(("null",)).admits("null")


@pytest.mark.parametrize("text", ["viz.example.org", "https://viz.example.org/", "", "https://a b"])
def test_what_is_no_origin_is_one_line(text):
    with pytest.raises(ConfigError, match="is not an origin; write it like https://"):
        OriginCheck((text,))


@given(st.text())
def test_any_text_may_be_sent(text):
    OriginCheck().admits(text)
    assert not OriginCheck().admits(f"https://{text}.example")
