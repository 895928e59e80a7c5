from __future__ import annotations

import io
from pathlib import Path
from types import SimpleNamespace

import pytest

from edoras_tools.cli.output import watcher
from edoras_tools.io import SourceDefaults
from edoras_tools.model import SourceInfo, SourceStatistics
from edoras_tools.render.capture import watch
from edoras_tools.render.terminal.live_table import LiveTable
from edoras_tools.render.terminal.palette import Terminal
from edoras_tools.render.terminal.progress import FileProgress

SOURCE = SimpleNamespace(info=SourceInfo("eth0", "live"), statistics=SourceStatistics())


def on_terminal(monkeypatch):
    stream = io.StringIO()
    stream.isatty = lambda: True
    monkeypatch.setattr("sys.stderr", stream)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(watch, "detect_terminal", lambda _: Terminal(80, colour=False, interactive=True))


@pytest.fixture
def terminal(monkeypatch):
    on_terminal(monkeypatch)


def test_live_sources_have_a_table_and_files_a_bar(monkeypatch):
    on_terminal(monkeypatch)
    assert isinstance(watcher(SOURCE, Path("a.mcap"), quiet=False, live=True), LiveTable)
    assert isinstance(watcher(SOURCE, None, quiet=False, live=False), FileProgress)


def test_quiet_shows_nothing(monkeypatch):
    on_terminal(monkeypatch)
    with watcher(SOURCE, None, quiet=True, live=True) as nothing:
        assert nothing is None


def test_no_terminal_shows_nothing(monkeypatch):
    monkeypatch.setattr("sys.stderr", io.StringIO())
    with watcher(SOURCE, None, quiet=False, live=True) as nothing:
        assert nothing is None


def test_recorded_says_what_the_file_holds(summary, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(bytes(13_000_000))
    said = watch.recorded(summary, [path])
    assert said == f"{path}: 1,827 datagrams over 65.3 s, 663 messages on 2 topics, 12.4 MiB"


def test_recorded_counts_a_directory_and_bears_an_empty_one(summary, tmp_path):
    (tmp_path / "metadata.yaml").write_bytes(bytes(1000))
    (tmp_path / "a.db3").write_bytes(bytes(1048))
    assert watch.recorded(summary, [tmp_path]).endswith(", 2.0 KiB")
    nothing = {"datagrams": 0, "routes": []}
    assert (
        watch.recorded(nothing, [tmp_path / "gone"])
        == f"{tmp_path / 'gone'}: 0 datagrams, 0 messages on 0 topics"
    )


class File(SourceDefaults):
    """A file of three batches, each of which takes a second to read."""

    info = SourceInfo("big.pcap", "pcap")

    def __init__(self, now):
        self.statistics = SourceStatistics(total_bytes=300)
        self._now = now

    def batches(self):
        for batch in range(3):
            self._now[0] += 1
            self.statistics.position += 100
            yield [batch]


@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("quiet", [False, True])
def test_a_source_that_is_followed_shows_how_far_it_is_until_something_is_printed(monkeypatch, quiet):
    now, drawn = [0.0], []

    class Bar(FileProgress):
        def __init__(self, label, **_):
            drawn.append(label)

        def read(self, source):
            drawn.append(source.statistics.position)

        def __exit__(self, *_):
            drawn.append("gone")

    monkeypatch.setattr(watch, "monotonic", lambda: now[0])
    monkeypatch.setattr("edoras_tools.render.terminal.progress.FileProgress", Bar)
    source = watch.Followed(File(now), quiet=quiet)
    assert (source.info.name, source.live) == ("big.pcap", False)
    printed = ([] if item == [0] else item for item in source.batches())
    assert list(source.printed(printed)) == [[], [1], [2]]
    told = ["big.pcap", 100, 200, "gone", "big.pcap", 300, "gone"]
    assert drawn == ([] if quiet else told)


@pytest.mark.usefixtures("terminal")
def test_bytes_are_counted_in_the_bar(monkeypatch):
    steps = []
    monkeypatch.setattr(FileProgress, "step", lambda _, *told: steps.append(told))
    with watch.byte_progress(Path("a.mcap"), quiet=False) as progress:
        progress(1024, 4096)
    with watch.byte_progress(Path("a.mcap"), quiet=True) as progress:
        progress(2048, 4096)
    ((what, done, of, shown),) = steps
    assert (what, shown(done), shown(of)) == ("checking", "1.0 KiB", "4.0 KiB")
