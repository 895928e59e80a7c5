"""The permission to open raw sockets: tried in processes of their own, which give it up."""

import os
import subprocess
import sys
import textwrap

import pytest

CODE = """
    import ctypes, socket
    from edoras_tools.errors import CaptureError
    from edoras_tools.io.capture.interfaces import claim_raw_sockets
    from edoras_tools.io.capture.ring import _socket

    def state():
        with open("/proc/thread-self/status") as file:
            status = dict(line.split(":\\t", 1) for line in file)
        return [int(status[name], 16) for name in ("CapEff", "CapPrm")]

    header, values = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    values[1] = {permitted}
    assert ctypes.CDLL(None).capset(header, values) == 0
    assert state() == [0, {permitted}]
    try:
        _socket("lo", cooked=False).close()
        print("opened", *state())
    except CaptureError as error:
        print("refused", *state(), error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has a capability to give up")
@pytest.mark.parametrize(
    ("permitted", "seen"),
    [
        (1 << 13, "opened 8192 8192\n"),
        (0, "refused 0 0 lo: capturing needs CAP_NET_RAW: "),
        (1 << 12, "refused 0 4096 lo: capturing needs CAP_NET_RAW: "),
    ],
)
def test_what_is_permitted_is_used_and_nothing_more(permitted, seen):
    code = textwrap.dedent(CODE.format(permitted=permitted))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.startswith(seen), done.stderr
