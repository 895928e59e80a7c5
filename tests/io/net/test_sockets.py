"""Addresses as text, and which of them are this machine's own."""

from __future__ import annotations

import contextlib
import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st
from namespace import Cable, inside, ip

from edoras_tools.errors import ConfigError
from edoras_tools.io.net.sockets import arrives_at, is_loopback, own_address, parse_endpoint
from edoras_tools.model import Endpoint

PAIRS = {
    ("127.0.0.1", "127.0.0.1"): True,
    ("localhost", "localhost"): True,
    ("localhost", "127.0.0.1"): True,
    ("127.0.0.2", "127.0.0.1"): False,
    ("127.0.0.1", "0.0.0.0"): True,
    ("127.1.2.3", "0.0.0.0"): True,
    ("localhost", "0.0.0.0"): True,
    ("0.0.0.0", "0.0.0.0"): True,
    ("0.0.0.0", "127.0.0.1"): True,
    ("192.0.2.1", "0.0.0.0"): False,
    ("192.0.2.1", "::"): False,
    ("::1", "::"): True,
    ("127.0.0.1", "::"): True,
    ("::ffff:127.0.0.1", "0.0.0.0"): True,
    ("::1", "0.0.0.0"): False,
    ("no.such.host.invalid", "0.0.0.0"): False,
}


@pytest.mark.parametrize(("target", "listen"), PAIRS)
def test_who_hears_itself(target, listen):
    if target == "localhost" and socket.getaddrinfo(target, 7)[0][0] != socket.AF_INET:
        pytest.skip("localhost is an IPv6 address here")
    assert arrives_at(Endpoint(target, 7), Endpoint(listen, 7)) is PAIRS[target, listen]
    assert not arrives_at(Endpoint(target, 8), Endpoint(listen, 7))


def test_an_interface_s_address_is_this_machine_s_own():
    def told():
        cable = Cable("edown")
        cable.lay()
        ip("addr", "add", "192.0.2.7/24", "dev", cable.name)
        return [arrives_at(Endpoint(f"192.0.2.{own}", 7), Endpoint("0.0.0.0", 7)) for own in (7, 8)]

    assert inside(told) == [True, False]


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("127.0.0.1:1235", Endpoint("127.0.0.1", 1235)),
        ("localhost:0x4d3", Endpoint("localhost", 1235)),
        ("1235", Endpoint("127.0.0.1", 1235)),
        ("[::1]:1235", Endpoint("::1", 1235)),
        ("[fe80::1%lo]:0", Endpoint("fe80::1%lo", 0)),
    ],
)
def test_endpoints_as_text(text, endpoint):
    assert parse_endpoint(text) == endpoint


@pytest.mark.parametrize(
    "text",
    ["", ":", ":1235", "localhost", "localhost:", "a:b", "::1:1235", "[::1]", "h:65536", "h:-1", "010"],
)
def test_text_that_is_no_endpoint(text):
    with pytest.raises(ConfigError, match="HOST:PORT"):
        parse_endpoint(text)


@given(st.text(max_size=30) | st.from_regex(r"[\[\]:.0-9a-f]{0,20}"))
def test_any_text_is_an_endpoint_or_refused(text):
    with contextlib.suppress(ConfigError):
        assert 0 <= parse_endpoint(text).port <= 65535


def test_the_own_address_is_on_the_way_to_the_target():
    assert own_address(Endpoint("127.0.0.1", 9)) == "127.0.0.1"
    assert own_address(Endpoint("no.such.host.invalid", 9)) == "127.0.0.1"


@pytest.mark.parametrize(
    ("host", "own"),
    [("127.3.4.5", True), ("::1", True), ("192.0.2.1", False), ("no.such.host.invalid", False)],
)
def test_what_is_the_loopback(host, own):
    assert is_loopback(host) is own
