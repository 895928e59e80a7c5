"""``--user``: who captures gives up root once the capture is open, and what it writes is that user's."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from namespace import Cable, inside
from places import ROOT
from waiting import HOST, Program, free_ports

START = "from edoras_tools.cli.programs import main; main()"
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root becomes somebody else")


@pytest.fixture
def place():
    """A folder of nobody's, in one that it may only pass through; pytest's own are its user's alone."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o711)
        own = Path(folder) / "own"
        own.mkdir()
        os.chown(own, 65534, 65534)
        yield own


@pytest.fixture
def program(command, place):
    """The command as nobody can run it too: Python may lie in root's home, and is then mounted elsewhere."""
    home = Path(sys.base_prefix)
    as_nobody = {"user": 65534, "group": 65534, "extra_groups": []}
    if subprocess.run(["cat", os.__file__], capture_output=True, check=False, **as_nobody).returncode == 0:
        return [command]
    mounted = place.parent / "python"
    mounted.mkdir()
    run = f"mount --bind {home} {mounted} && exec {mounted}/bin/python3 -c '{START}' \"$@\""
    paths = [str(ROOT), *(path for path in sys.path if path.endswith("site-packages"))]
    words = ["unshare", "--mount", "env", f"PYTHONPATH={':'.join(paths)}", "sh", "-c", run, "edoras"]
    done = subprocess.run([*words, "--version"], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"nobody cannot read Python here, and it cannot be mounted elsewhere: {done.stderr}")
    return words


def identities(program):
    """Who each thread is, and what it may do."""
    for status in Path(f"/proc/{program.process.pid}/task").glob("*/status"):
        lines = status.read_text().splitlines()
        yield {name: text.split() for name, _, text in (line.partition(":\t") for line in lines)}


def is_nobody(program):
    return {tuple(one["Uid"]) for one in identities(program)} == {("65534",) * 4} and all(
        int(one["CapEff"][0], 16) == int(one["CapPrm"][0], 16) == 0 and one["NoNewPrivs"] == ["1"]
        for one in identities(program)
    )


@pytest.mark.quick("live0")
@pytest.mark.parametrize("live", [("-i", "lo", "-a"), ("--listen", "{port}")])
def test_root_is_given_up_and_the_capture_goes_on(program, place, live):
    (port,) = free_ports(1)
    words = [word.replace("{port}", str(port)) for word in live]
    path = place / "x.mcap"
    words += ["-n", "1", "--user", "nobody", "-o", path, "--port", f"ci:{port}"]
    with Program(*program, "record", *words) as running:
        while "capturing on" not in running.line(running.err):
            pass
        assert is_nobody(running)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(b"hello", (HOST, port))
        running.end(how=None)
    assert path.stat().st_uid == 65534


@pytest.mark.long
@pytest.mark.parametrize("deleted", [False, True], ids=["down", "deleted"])
def test_the_socket_that_is_kept_follows_the_interface(program, place, datagrams, deleted):
    """Nobody may open another one: it is bound again when the interface is back, or is made anew."""
    path, cable = place / "x.pcap", Cable("cable")

    def work():
        cable.lay()
        with Program(*program, "record", "-i", "cable", "--user", "nobody", "-o", path) as running:

            def said(word):
                while word not in (line := running.line(running.err)):
                    pass
                return line

            said("capturing")
            assert is_nobody(running)
            cable.send(b"before")
            cable.remove() if deleted else cable.switch("down")
            assert said("waiting").endswith(
                f"cable is {'not there' if deleted else 'down'}; waiting for it\n"
            )
            cable.lay() if deleted else cable.switch("up")
            said("back")
            cable.send(b"after")
            running.end(signal.SIGINT)

    inside(work)
    assert [item.payload for item in datagrams(path)] == [b"before", b"after"]


@pytest.mark.long
def test_a_folder_that_the_user_cannot_write_is_refused_at_the_start(program, place):
    words = ["record", "-i", "lo", "--user", "nobody", "-o", str(place.parent / "x.mcap")]
    done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"edoras: {place.parent}: nobody cannot write there: ")
    assert f"'chown nobody {place.parent}', or name a folder of nobody's with -o" in line
    assert not (place.parent / "x.mcap").exists()


@pytest.mark.long
def test_so_is_what_live_records(program, place):
    words = ["live", "-i", "lo", "--ws-port", "0", "--user", "nobody", "-o", str(place.parent / "x.mcap")]
    done = subprocess.run([*program, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, "nobody cannot write there" in done.stderr) == (1, True)


def test_files_are_read_as_who_one_is(edoras, captures):
    done = edoras("record", "-r", captures("a_rover"), "--user", "nobody", "-o", "/dev/null/x.mcap")
    assert done.returncode == 2
    assert b"--user can only be used with live traffic" in done.stderr
