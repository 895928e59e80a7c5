"""Which addresses are this machine's own: what is sent to them comes in where it listens."""

import socket

import pytest

from edoras_tools.model import Endpoint
from edoras_tools.sources.sockaddr import comes_in

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
    assert comes_in(Endpoint(target, 7), Endpoint(listen, 7)) is PAIRS[target, listen]
    assert not comes_in(Endpoint(target, 8), Endpoint(listen, 7))


def test_an_interface_s_address_is_this_machine_s_own():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it only chooses a way
        except OSError:
            pytest.skip("there is no interface but the loopback")
        own = probe.getsockname()[0]
    assert comes_in(Endpoint(own, 7), Endpoint("0.0.0.0", 7))
