"""``edoras`` in processes that have its modules already: a server forks them, each is a process of its own.

To start is most of what a short command takes; for tests that run many, and are not about how it starts.
"""

import json
import os
import pkgutil
import socket
import subprocess
import sys
from contextlib import contextmanager, suppress
from importlib import import_module
from io import FileIO, TextIOWrapper
from pathlib import Path

PRELOADED = ("cli", "pipelines", "render")


@contextmanager
def server():
    """Give a function that runs a line's words here and now; returns exit code and both outputs, as said."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    process = subprocess.Popen(
        [sys.executable, __file__, str(theirs.fileno())],
        pass_fds=[theirs.fileno()],
        stdin=subprocess.DEVNULL,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},  # as edoras does: threads do not survive a fork
    )
    theirs.close()

    def run(words):
        given = json.dumps([words, str(Path.cwd()), dict(os.environ)]).encode()
        reading, writing = os.pipe()
        socket.send_fds(ours, [given], [writing])
        os.close(writing)
        with os.fdopen(reading, "rb") as pipe:
            text = pipe.read().decode()
        return int(ours.recv(16)), text

    with process, ours:
        yield run


def serve(asked):
    """Fork a command for each request, one after the other, until the socket is closed."""
    for name in PRELOADED:
        package = import_module(f"edoras_tools.{name}")
        for item in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            with suppress(ImportError):  # of an extra that is not installed
                import_module(item.name)
    while True:
        given, outputs, _, _ = socket.recv_fds(asked, 1 << 20, 1)
        if not given:
            return
        if not (child := os.fork()):
            become(outputs[0], *json.loads(given))
        os.close(outputs[0])
        asked.send(str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode())


def become(output, words, folder, environ):
    """Be the command that somebody typed in a folder."""
    from edoras_tools.cli import programs

    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(output, number)
        setattr(sys, name, TextIOWrapper(FileIO(number, "w"), write_through=True))
    os.close(output)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environ)
    sys.argv = words
    programs.main()


if __name__ == "__main__":
    serve(socket.socket(fileno=int(sys.argv[1])))
