"""``edoras`` in processes that have its modules already: a server forks them, each is a process of its own.

To start is most of what a short command takes; for tests that run many, and are not about how it starts.
A server may have a folder of packages of its own, as ``PYTHONPATH`` names one.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import pkgutil
import socket
import subprocess
import sys
import threading
from contextlib import redirect_stdout, suppress
from functools import cache
from importlib import import_module
from io import FileIO, StringIO, TextIOWrapper
from pathlib import Path

EDORAS = Path(sys.executable).with_name("edoras")
PRELOADED = ("cli", "pipelines", "render")
PLAIN = (True, None, None, None, -1, False)
"""What ``Popen`` is told of signals, groups, user, umask and session where nobody asks for any."""
PR_SET_CHILD_SUBREAPER = 36
ONE_AT_A_TIME = threading.Lock()
"""Whose child a command becomes is a setting of the whole process: two threads would undo each other's."""


class Popen(subprocess.Popen):
    """``subprocess.Popen``, but ``edoras`` comes from the server, unless it is to start in a special way.

    Args:
        packages: a folder of packages that it has too.
    """

    def __init__(self, *arguments, packages="", **options):
        self._packages = str(packages)
        super().__init__(*arguments, **options)

    def _execute_child(self, args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest):
        ends, how = rest[3:9], rest[9 : 9 + len(PLAIN)]
        environ = dict(os.environ if env is None else env)
        special = preexec_fn or pass_fds or how != PLAIN or _of_start(environ) != _of_start(os.environ)
        special = special or not _in_its_network()
        if special or args[0] != str(EDORAS):
            super()._execute_child(args, executable, preexec_fn, close_fds, pass_fds, cwd, env, *rest)
            return
        streams = [end if end >= 0 else number for number, end in enumerate((ends[0], ends[3], ends[5]))]
        with ONE_AT_A_TIME:
            server = _server(os.getpid(), self._packages)
            self.pid = server.start([*map(os.fspath, args)], str(cwd or Path.cwd()), streams, environ)
        self._child_created = True
        self._close_pipe_fds(*ends)


def run(*arguments, **options):
    """Run ``edoras`` as ``subprocess.run`` does; its output is taken."""
    data = options.pop("input", None)
    usual = {"stdin": subprocess.DEVNULL if data is None else subprocess.PIPE}
    usual |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    words = [str(EDORAS), *map(str, arguments)]
    with Popen(words, **usual | options) as process:
        try:
            out, err = process.communicate(data, timeout=300)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(words, process.returncode, out, err)


def _of_start(environ):
    """Return of an environment what Python and its libraries read as they start."""
    return {name: value for name, value in environ.items() if name.startswith(("PYTHON", "LD_", "OPENBLAS"))}


def _in_its_network():
    """Tell whether this thread is in the network that the process, and so the server, is in."""
    return Path("/proc/self/ns/net").readlink() == Path("/proc/thread-self/ns/net").readlink()


class _Server:
    """The side of the tests."""

    def __init__(self, packages):
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environ = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}  # as edoras does: threads do not survive a fork
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            stdin=subprocess.DEVNULL,
            env=environ | ({"PYTHONPATH": packages} if packages else {}),
        )
        theirs.close()

    def start(self, words, folder, streams, environ):
        """Start a process, a child of this one; return its number."""
        prctl = ctypes.CDLL(None).prctl
        prctl(PR_SET_CHILD_SUBREAPER, 1)  # whose parent ends, it becomes the child of this process
        try:
            given = json.dumps([words, folder, environ]).encode()
            socket.send_fds(self._socket, [given], streams)
            child = int(self._socket.recv(16))
            assert self._socket.recv(16) == b"parent ended"
        finally:
            prctl(PR_SET_CHILD_SUBREAPER, 0)
        return child


@cache
def _server(_process, packages):
    return _Server(packages)


def serve(asked):
    """Fork a command for each request, by way of a parent that ends, until the socket is closed."""
    del sys.path[0]  # of this file
    for name in PRELOADED:
        package = import_module(f"edoras_tools.{name}")
        for item in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):  # of an extra that is not installed
                import_module(item.name)
    _try_out()
    gc.freeze()  # what is loaded is never garbage: the forks leave its memory alone
    while True:
        given, streams, _, _ = socket.recv_fds(asked, 1 << 20, 3)
        if not given:
            return
        if not (parent := os.fork()):
            if child := os.fork():
                asked.send(str(child).encode())
                os._exit(0)
            asked.close()
            become(streams, *json.loads(given))
        for stream in streams:
            os.close(stream)
        os.waitpid(parent, 0)
        asked.send(b"parent ended")


def _try_out():
    """Run two commands here, so that what they load and make at their first time is there: 40 of 85 ms."""
    from edoras_tools.cli import main

    capture = Path(__file__).parents[2] / "samples/captures/b_arm_single.pcap"
    for command in ("sniff", "doctor"):
        sys.argv = ["edoras", command, str(capture)]
        with redirect_stdout(StringIO()), suppress(SystemExit):
            main.run(main.program(command))


def become(streams, words, folder, environ):
    """Be the command that somebody typed in a folder."""
    from edoras_tools.cli import programs

    for number, (name, stream) in enumerate(zip(("stdin", "stdout", "stderr"), streams, strict=True)):
        os.dup2(stream, number)
        os.close(stream)
        old = getattr(sys, name)
        how = {"encoding": old.encoding, "errors": old.errors}
        setattr(sys, name, os.fdopen(number, old.mode, closefd=False, **how))
    sys.stderr.reconfigure(line_buffering=True)
    if os.path.sameopenfile(1, 2):  # both in the order of the writing
        sys.stdout = TextIOWrapper(FileIO(1, "w", closefd=False), write_through=True)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environ)
    sys.argv = words
    programs.main()


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
