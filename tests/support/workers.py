"""``--workers N``: the tests are collected once; N forks of this process take their files from one queue.

Programs that each collect the tests for themselves take 15 s of CPU each before the first test. A worker has
a network and a temporary folder of its own; one that dies fails the test it was at, and another goes on with
the rest. What ends the run (Ctrl-C, ``-x``) lets each worker end its test and take down what it set up.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import subprocess
import sys
import traceback
import warnings
from itertools import chain, count, groupby, pairwise
from multiprocessing.connection import Pipe, wait
from types import SimpleNamespace

import pytest
from namespace import enter
from order import together

NUMBER = 4
"""Bytes of a file's number in the queue."""
ALPHABET = "from hypothesis.strategies import text; text().validate()"
"""Has Hypothesis keep which characters there are: 4 s for each worker, where a clone is new."""

PREPARATION = pytest.StashKey()


def pytest_addoption(parser):
    parser.addoption("--workers", type=int, default=0, metavar="N", help="run files of tests in N processes")


def pytest_configure(config):
    if config.option.workers and "hypothesis" in sys.modules and not config.option.collectonly:
        config.stash[PREPARATION] = subprocess.Popen([sys.executable, "-c", ALPHABET], cwd=config.rootpath)


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session):
    """Run the tests in workers, where some are asked for and there is something to run."""
    option = session.config.option
    if not option.workers or option.collectonly or not session.items:
        return None
    if session.testsfailed and not option.continue_on_collection_errors:
        return None
    if terminal := session.config.pluginmanager.getplugin("terminalreporter"):
        terminal.showfspath = False  # tests of several files end in turn
    Crew(session).run(option.workers)
    if session.shouldfail:
        raise session.Failed(session.shouldfail)
    if session.shouldstop:
        raise session.Interrupted(session.shouldstop)
    return True


class Crew:
    """The first process's side: the queue, the workers, and what they say."""

    def __init__(self, session):
        self.session = session
        self.files = [list(items) for _, items in groupby(session.items, key=together)]
        self.unfinished = {item.nodeid for item in session.items}
        self.queue, filling = os.pipe()
        os.set_blocking(filling, False)  # more than it holds: an error, not a wait
        os.write(filling, b"".join(number.to_bytes(NUMBER, "big") for number in range(len(self.files))))
        os.close(filling)
        self.stopped, self._stop = os.pipe()
        self.folder = session.config._tmp_path_factory.getbasetemp()
        self.numbers = count()
        self.workers = []

    def run(self, size):
        """Run all tests.

        Raises:
            RuntimeError: workers ended without word, and tests did not run.
        """
        if preparation := self.session.config.stash.get(PREPARATION, None):
            preparation.wait()
        gc.freeze()  # what was collected is never garbage: the forks leave its memory alone
        try:
            for _ in range(min(size, len(self.files))):
                self.fork([])
            self.listen()
        except BaseException:
            self.stop()
            self.listen()
            raise
        finally:
            for worker in self.workers:
                os.kill(worker.process, signal.SIGKILL)
        if self.unfinished and self._stop:
            raise RuntimeError(f"no worker ran {', '.join(sorted(self.unfinished))}")

    def stop(self):
        """Let each worker end after its test."""
        if self._stop:
            os.close(self._stop)
            self._stop = None

    def fork(self, items):
        """Start a worker, with items that come before those of the queue."""
        receiving, sending = Pipe(duplex=False)
        number = next(self.numbers)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # threads of libraries wait for work
            process = os.fork()
        if not process:
            for other in [receiving, *(worker.receiving for worker in self.workers)]:
                other.close()
            if self._stop:
                os.close(self._stop)
            work(self, number, items, sending)
        sending.close()
        self.workers.append(
            SimpleNamespace(
                process=process,
                end=os.pidfd_open(process),
                receiving=receiving,
                items=list(items),
                last_words="",
            )
        )

    def listen(self):
        """Pass on what the workers say, until all have ended."""
        while self.workers:
            ready = wait([source for worker in self.workers for source in (worker.receiving, worker.end)])
            for worker in list(self.workers):
                if worker.receiving in ready or worker.end in ready:
                    ended = wait([worker.end], 0)  # asked first: what it says between is still to be read
                    while worker.receiving.poll():
                        try:
                            self.take(worker, *worker.receiving.recv())
                        except EOFError:
                            ended = wait([worker.end])
                            break
                    if ended:
                        self.bury(worker)
            if self.session.shouldfail or self.session.shouldstop:
                self.stop()

    def take(self, worker, name, values):
        """Do what a worker says: its own doings, or the hooks of pytest that a test of it called."""
        if name == "file":
            worker.items += self.files[values]
        elif name == "last words":
            worker.last_words = values
        else:
            for hook, arguments in values:
                self.call(worker, hook, arguments)

    def call(self, worker, name, values):
        """Call a hook of pytest here too."""
        hook = self.session.config.hook
        if name == "pytest_warning_recorded":
            hook.pytest_warning_recorded.call_historic(kwargs=values)
            return
        if isinstance(data := values.get("report"), dict):
            values["report"] = hook.pytest_report_from_serializable(config=self.session.config, data=data)
        elif name == "pytest_runtest_logfinish":
            self.unfinished.remove(values["nodeid"])
            del worker.items[0]  # they end in their order
        getattr(hook, name)(**values)

    def bury(self, worker):
        """Take a worker's end: a failure of the test it was at, where it did not just run out of tests."""
        code = os.waitstatus_to_exitcode(os.waitpid(worker.process, 0)[1])
        self.workers.remove(worker)
        worker.receiving.close()
        os.close(worker.end)
        if code == 0:
            return
        if not worker.items:
            raise RuntimeError(f"a worker ended with exit code {code} between tests\n{worker.last_words}")
        item, *rest = worker.items
        text = f"its process ended with exit code {code}\n{worker.last_words}"
        report = pytest.TestReport(item.nodeid, item.location, {}, "failed", text, "call")
        self.session.config.hook.pytest_runtest_logreport(report=report)
        self.unfinished.remove(item.nodeid)
        if self._stop:
            self.fork(rest)


class Sender:
    """A plugin of a worker: tells the first process, test by test, what pytest tells its plugins."""

    def __init__(self, config, send):
        self._config, self._send, self.ready, self._calls = config, send, False, []

    def pytest_runtest_logstart(self, nodeid, location):
        self._calls.append(("pytest_runtest_logstart", {"nodeid": nodeid, "location": location}))

    def pytest_runtest_logreport(self, report):
        if report.longrepr is not None:  # of other kinds than text
            report = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._calls.append(("pytest_runtest_logreport", {"report": report}))

    def pytest_runtest_logfinish(self, nodeid, location):
        self._calls.append(("pytest_runtest_logfinish", {"nodeid": nodeid, "location": location}))
        self.flush()

    def pytest_warning_recorded(self, warning_message, when, nodeid, location):
        if self.ready:  # what comes as it is registered, the first process has
            text = UserWarning(f"{warning_message.category.__name__}: {warning_message.message}")
            message = warnings.WarningMessage(
                text, UserWarning, warning_message.filename, warning_message.lineno
            )
            values = {"warning_message": message, "when": when, "nodeid": nodeid, "location": location}
            self._calls.append(("pytest_warning_recorded", values))

    def flush(self):
        """Send what there is."""
        self._send(("calls", self._calls))
        self._calls = []


def work(crew, number, items, sending):
    """Be a worker, to its end."""
    code = 1
    try:
        sender = _prepare(crew, number, sending)
        for item, following in pairwise(chain(items, _items(crew, sending), [None])):
            if crew.session.shouldfail or select.select([crew.stopped], [], [], 0)[0]:
                break
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        crew.session._setupstate.teardown_exact(None)
        sender.flush()
        code = 0
    except BaseException:  # noqa: BLE001  a test that stops pytest itself, or an error outside tests
        with contextlib.suppress(OSError):
            sending.send(("last words", traceback.format_exc()))
    finally:
        os._exit(code)


def _prepare(crew, number, sending):
    config = crew.session.config
    config.workerinput = {}  # what pytest keeps of a run, the first process keeps
    config.pluginmanager.unregister(name="terminalreporter")
    config.pluginmanager.register(sender := Sender(config, sending.send))
    sender.ready = True
    if capture := config.pluginmanager.getplugin("capturemanager"):
        capture.stop_global_capturing()  # its file is one with that of the others
        capture.start_global_capturing()
        capture.suspend_global_capture()
    config._tmp_path_factory._basetemp = crew.folder / f"worker{number}"
    config._tmp_path_factory._basetemp.mkdir()
    with contextlib.suppress(OSError):
        enter()
    return sender


def _items(crew, sending):
    while number := os.read(crew.queue, NUMBER):
        sending.send(("file", int.from_bytes(number, "big")))
        yield from crew.files[int.from_bytes(number, "big")]
