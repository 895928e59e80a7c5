"""Send datagrams to a loopback port at a rate, in bursts of a millisecond; print what was sent as JSON.

Run: python sender.py PORT RATE BYTES SECONDS
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import time
from contextlib import suppress


def main() -> None:
    """Send."""
    port, rate, size, seconds = (int(argument) for argument in sys.argv[1:5])
    # A command packet of cFE, so that the receiver has something to decode.
    payload = struct.pack(">HHHBB", 0x1827, 0, size - 7, 1, 0) + bytes(size - 8)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody,
    ):
        with suppress(OSError):  # the program that is measured has the port
            nobody.bind(("127.0.0.1", port))  # else each datagram has an ICMP answer, which is captured too
        sender.connect(("127.0.0.1", port))
        print("sending", file=sys.stderr, flush=True)
        began = time.perf_counter()
        sent = 0
        for step in range(seconds * 1000):
            ahead = began + step / 1000 - time.perf_counter()
            if ahead > 0:
                time.sleep(ahead)
            for _ in range(rate * (step + 1) // 1000 - sent):
                sender.send(payload)
                sent += 1
        print(json.dumps({"sent": sent, "seconds": time.perf_counter() - began}))


if __name__ == "__main__":
    main()
