"""Root given up: tried in processes of their own, as there is no way back."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import textwrap
from pathlib import Path

import pytest

from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.io.privileges import check_writable, find_user

AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes somebody else")


@pytest.fixture
def place():
    """A folder that all may pass through; pytest's own are its user's alone."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o711)
        yield Path(folder)


def test_accounts_that_cannot_be_meant():
    with pytest.raises(ConfigError, match="no such account"):
        find_user("no-such-account")
    with pytest.raises(ConfigError, match="that is root"):
        find_user("root")


def test_only_root_becomes_somebody_else(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    with pytest.raises(ConfigError, match="only root can change to another user"):
        find_user("nobody")


@AS_ROOT
def test_where_the_account_can_write(place):
    nobody = find_user("nobody")
    for name, mode in (("open", 0o777), ("closed", 0o755)):
        (place / name).mkdir()
        (place / name).chmod(mode)
    check_writable(nobody, place / "open")
    check_writable(nobody, place / "open/not/there/yet")
    with pytest.raises(CaptureError, match=r"closed: nobody cannot write there: .*'chown nobody .*closed'"):
        check_writable(nobody, place / "closed")
    assert os.geteuid() == 0
    assert list((place / "open").iterdir()) == []


@AS_ROOT
def test_there_is_no_way_back():
    code = """
        import os, socket, threading
        from edoras_tools.io.privileges import become, find_user, forbid_new_privileges
        opened = socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)
        gate, seen = threading.Event(), []
        other = threading.Thread(target=lambda: (gate.wait(), seen.append(os.getresuid())))
        other.start()
        nobody = find_user("nobody")
        forbid_new_privileges()
        become(nobody)
        gate.set()
        other.join()
        assert seen == [(nobody.uid,) * 3] == [os.getresuid()], seen
        assert os.getresgid() == (nobody.gid,) * 3 and 0 not in os.getgroups()
        status = open("/proc/self/status").read()
        assert all(f"{name}:\\t0000000000000000" in status for name in ("CapPrm", "CapEff", "CapAmb")), status
        assert "NoNewPrivs:\\t1" in status
        opened.bind(("lo", 3))  # the socket is kept, and can be bound
        opened.close()
        for act in (lambda: os.setuid(0), lambda: os.seteuid(0), lambda: os.setgroups([0]),
                    lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)):
            try:
                act()
            except PermissionError:
                continue
            raise AssertionError("root is back")
        print("done")
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, check=False
    )
    assert done.stdout == "done\n", done.stderr
