"""What the tests of capturing share."""

from __future__ import annotations

import socket

import pytest


@pytest.fixture
def pair():
    """A sender connected to a receiver on loopback, and the receiver's port."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        sender.connect(receiver.getsockname())
        yield sender, receiver.getsockname()[1]
