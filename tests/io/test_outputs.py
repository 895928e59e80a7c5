"""Outputs in a folder for all: links of one's own are followed, others are not."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest
from places import ROOT

from edoras_tools.errors import CaptureError
from edoras_tools.io.formats.mcap.file import McapFile
from edoras_tools.io.formats.pcap import PcapSink
from edoras_tools.io.outputs import (
    NewFile,
    OutputFile,
    Patience,
    check_links,
    check_new,
    name_that_fits,
    opener,
    path_beside,
    waiting_for_room,
    write_bytes,
)

PACKAGE = ROOT / "edoras_tools"
NOBODY = 65534
AS_ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root makes links of another user")


@pytest.fixture
def for_all(tmp_path):
    """A folder as /tmp is, and a file elsewhere."""
    folder = tmp_path / "for_all"
    folder.mkdir()
    folder.chmod(0o1777)
    (tmp_path / "precious").write_bytes(b"precious")
    return folder


def link(place, target, owner=None):
    place.symlink_to(target)
    if owner is not None:
        os.lchown(place, owner, owner)
    return place


def test_files_and_links_of_one_s_own(for_all, tmp_path):
    write_bytes(for_all / "new", b"1")
    write_bytes(for_all / "new", b"22")
    assert (for_all / "new").read_bytes() == b"22"
    write_bytes(link(for_all / "mine", tmp_path / "precious"), b"333")
    assert (tmp_path / "precious").read_bytes() == b"333"


@AS_ROOT
@pytest.mark.parametrize("make", [McapFile, PcapSink, lambda path: write_bytes(path, b"")])
def test_a_link_of_somebody_else_is_refused(for_all, tmp_path, make):
    place = link(for_all / "x.mcap", tmp_path / "precious", NOBODY)
    with pytest.raises((CaptureError, OSError), match="is another user's link in a shared folder"):
        make(place)
    assert (tmp_path / "precious").read_bytes() == b"precious"


def test_a_file_that_cannot_be_written(tmp_path):
    with pytest.raises(CaptureError, match=r"no/x: cannot be written: No such file"):
        write_bytes(tmp_path / "no/x", b"")


@AS_ROOT
def test_a_folder_that_is_such_a_link_is_refused(for_all, tmp_path):
    place = link(for_all / "folder", tmp_path, NOBODY)
    with pytest.raises(OSError, match=r"for_all/folder is another user's link"):
        check_links(place / "x.mcap")


@AS_ROOT
def test_where_not_all_may_write_links_are_anybody_s(for_all, tmp_path):
    for_all.chmod(0o755)
    write_bytes(link(for_all / "x", tmp_path / "precious", NOBODY), b"new")
    assert (tmp_path / "precious").read_bytes() == b"new"


@AS_ROOT
def test_the_folder_s_owner_may_link(for_all, tmp_path):
    os.chown(for_all, NOBODY, NOBODY)
    write_bytes(link(for_all / "x", tmp_path / "precious", NOBODY), b"new")
    assert (tmp_path / "precious").read_bytes() == b"new"


def test_a_link_that_appears_at_the_last_moment_is_not_followed(for_all, tmp_path, monkeypatch):
    """Between the look and the opening: the system's own check holds."""
    place, real = for_all / "x", os.open
    monkeypatch.setattr(os, "open", lambda *given: (link(place, tmp_path / "precious"), real(*given))[1])
    with pytest.raises(OSError, match="is another user's link"):
        opener(str(place), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    assert (tmp_path / "precious").read_bytes() == b"precious"


@AS_ROOT
def test_folders_are_not_made_through_such_a_link(for_all, tmp_path):
    place = link(for_all / "folder", tmp_path, NOBODY)
    with pytest.raises(CaptureError, match="is another user's link"):
        write_bytes(place / "deep/x.c", b"", folders=True)
    assert not (tmp_path / "deep").exists()


_WRITES = re.compile(r"\.write_(text|bytes)\(|open\([^()]*[\"']([wax]b?[+]?|r[+]b)[\"']|\.touch\(\)")


def test_nobody_writes_files_in_another_way():
    """What writes a file does it here, or opens it by ``opener``; a help page's formatter writes no file."""
    others = {
        "cli/main.py": "the null device",
        "addons/wireshark/extcap.py": "a pipe of Wireshark's",
        "addons/debug_info/dwarf.py": "in a temporary folder of its own",
        "addons/cfdp/taking.py": "pieces as they come, in a folder that is its own until the end",
    }
    found = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        for line in path.read_text().splitlines()
        if _WRITES.search(line) and "opener=opener" not in line and "formatter.write_text" not in line
    }
    assert found == set(others)


class TestOutputFile:
    """A file that one program writes and others may take away."""

    @pytest.fixture
    def file(self, tmp_path):
        made = OutputFile(tmp_path / "x.mcap")
        made.write(b"one", memoryview(b"two"))
        yield made
        made.close()

    def test_a_second_writer_is_refused_and_nothing_is_lost(self, file):
        with pytest.raises(BlockingIOError, match="another program is writing it"):
            OutputFile(file.path)
        assert file.path.read_bytes() == b"onetwo"
        file.close()

    def test_nothing_is_left_of_what_got_no_byte(self, file, tmp_path):
        empty = OutputFile(tmp_path / "empty")
        with pytest.raises(BlockingIOError):
            OutputFile(empty.path)
        assert empty.path.exists(), "the second one does not remove what is the first one's"
        empty.close()
        assert not empty.path.exists()
        taken = OutputFile(tmp_path / "taken")
        taken.path.unlink()
        taken.path.write_bytes(b"")
        taken.close()
        assert taken.path.exists(), "it is another file"
        file.close()
        assert file.path.read_bytes() == b"onetwo"

    def test_what_is_as_it_should_be(self, file):
        assert (file.fate(), file.place, file.size) == ("", file.path, 6)

    def test_deleted(self, file):
        file.path.unlink()
        assert (file.fate(), file.place) == ("was deleted", None)

    def test_deleted_with_its_folder(self, tmp_path):
        (tmp_path / "a").mkdir()
        file = OutputFile(tmp_path / "a/x.mcap")
        shutil.rmtree(tmp_path / "a")
        assert file.fate() == "was deleted"

    def test_moved(self, file, tmp_path):
        file.path.rename(tmp_path / "y.mcap")
        assert (file.fate(), file.place) == (f"was moved to {tmp_path}/y.mcap", tmp_path / "y.mcap")
        file.write(b"three")
        assert (tmp_path / "y.mcap").read_bytes() == b"onetwothree"

    def test_replaced(self, file, tmp_path):
        (tmp_path / "y").write_bytes(b"onetwo")
        (tmp_path / "y").rename(file.path)
        assert file.fate() == "was replaced by another file"

    def test_truncated_it_gets_no_more(self, file):
        """Also where nobody looked before the next write: it would end in a hole."""
        os.truncate(file.path, 2)
        file.write(b"three")
        assert (file.fate(), file.path.read_bytes()) == ("was truncated", b"on")

    def test_what_is_no_file_is_only_written(self):
        first, second = OutputFile(Path("/dev/null")), OutputFile(Path("/dev/null"))
        first.write(b"x" * 100)
        assert (first.fate(), second.fate()) == ("", "")

    def test_a_file_is_replaced_when_the_new_one_is_complete(self, file, tmp_path):
        file.close()
        file.path.chmod(0o640)
        new = OutputFile(file.path)
        with pytest.raises(BlockingIOError):
            OutputFile(file.path)
        new.write(b"new")
        assert (new.older, new.path) == (file.path, tmp_path / "x_1.mcap")
        assert (file.path.read_bytes(), new.path.read_bytes(), new.fate()) == (b"onetwo", b"new", "")
        new.finish()
        assert (new.older, new.path, new.fate()) == (None, file.path, "")
        assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("x.mcap", b"new")]
        assert file.path.stat().st_mode & 0o777 == 0o640

    @pytest.mark.parametrize("how", ["closed", "spared", "moved", "empty"])
    def test_an_older_file_stays(self, file, tmp_path, how):
        """Where the new one is not complete, is not to replace it, or is gone."""
        file.close()
        new = OutputFile(file.path)
        new.write(b"new" if how != "empty" else b"")
        if how == "moved":
            new.path.rename(tmp_path / "y.mcap")
        new.spares = how == "spared"
        if how in {"spared", "moved"}:
            new.finish()
        new.close()
        found = {item.name: item.read_bytes() for item in tmp_path.iterdir()}
        beside = {"closed": "x_1.mcap", "spared": "x_1.mcap", "moved": "y.mcap"}
        assert found == {"x.mcap": b"onetwo", **({beside[how]: b"new"} if how in beside else {})}
        OutputFile(file.path).close()  # no lock is left

    def test_what_a_link_of_one_s_own_names_is_replaced(self, file, tmp_path):
        file.close()
        place = link(tmp_path / "link.mcap", file.path)
        new = OutputFile(place)
        new.write(b"new")
        new.finish()
        assert (place.readlink(), file.path.read_bytes()) == (file.path, b"new")

    def test_many_pieces(self, file):
        file.write(*[b"%d" % (number % 10) for number in range(3000)])
        assert file.path.stat().st_size == file.size == 3006


class TestNewFile:
    """A file that gets its name when it is complete."""

    def test_it_replaces_at_the_end(self, tmp_path):
        path = tmp_path / "x"
        path.write_bytes(b"old")
        path.chmod(0o600)
        with NewFile(path) as file:
            file.write(b"new")
            file.flush()
            assert path.read_bytes() == b"old"
        assert (path.read_bytes(), path.stat().st_mode & 0o777) == (b"new", 0o600)
        assert list(tmp_path.iterdir()) == [path]

    @pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
    def test_after_an_exception_nothing_of_it_is_left(self, tmp_path, error):
        path = tmp_path / "x"
        path.write_bytes(b"old")

        def write():
            with NewFile(path) as file:
                file.write(b"new")
                raise error

        with pytest.raises(type(error)):
            write()
        assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("x", b"old")]

    def test_a_disk_that_is_full_at_the_last_byte(self, tmp_path):
        """What is buffered is written when the file is closed."""
        path = tmp_path / "x"
        path.write_bytes(b"old")
        file = NewFile(path)
        file.file.write(b"new")
        os.dup2(full := os.open("/dev/full", os.O_WRONLY), file.file.fileno())
        os.close(full)
        with pytest.raises(OSError, match="No space left"):
            file.keep()
        assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("x", b"old")]

    def test_a_part_of_a_process_that_was_killed_is_in_nobody_s_way(self, tmp_path):
        part = tmp_path / f".x.{os.getpid()}.part"
        part.write_bytes(b"left")
        with NewFile(tmp_path / "x") as file:
            file.write(b"new")
        assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("x", b"new")]

    def test_what_is_being_written_is_not_replaced(self, tmp_path, monkeypatch):
        writer = OutputFile(tmp_path / "x")
        writer.write(b"a recording")
        for replace in (lambda path: write_bytes(path, b"page"), lambda path: check_new(path, force=True)):
            with pytest.raises(CaptureError, match="x: cannot be written: another program is writing it"):
                replace(writer.path)
        writer.finish()
        monkeypatch.delattr(os, "O_TMPFILE")  # as where a file must have a name
        write_bytes(tmp_path / "x", b"page")
        assert [(item.name, item.read_bytes()) for item in tmp_path.iterdir()] == [("x", b"page")]

    def test_long_names(self, tmp_path):
        assert name_that_fits("short", ".csv") == "short.csv"
        names = [name_that_fits("\u00e4" * 150 + end, ".csv") for end in "ab"]
        assert names[0] != names[1]
        assert max(len(name.encode()) for name in names) < 200
        write_bytes(tmp_path / ("x" * 255), b"new")
        assert [item.name for item in tmp_path.iterdir()] == ["x" * 255]


def test_a_full_disk_is_waited_for(tmp_path, monkeypatch):
    real, lines, over = os.writev, [], []
    monkeypatch.setattr("edoras_tools.io.outputs._LOOK_S", 0)
    full = [28, 28]

    def writev(fileno, pieces):
        if full:
            raise OSError(full.pop(), "No space left on device")
        return real(fileno, pieces)

    with waiting_for_room(Patience(lines.append, lambda: bool(over))):
        file = OutputFile(tmp_path / "x")
        monkeypatch.setattr(os, "writev", writev)
        with pytest.raises(OSError, match="No space"):
            file.write(b"what has not begun does not wait")
        full.clear()
        file.write(b"goes ")
        full[:] = [28, 28]
        file.write(b"on")
        assert (file.path.read_bytes(), len(file.waits), len(lines)) == (b"goes on", 1, 2)
        assert lines[0].endswith("x: the disk is full; the recording waits for room")
        full[:], over[:] = [28], [True]  # Ctrl-C
        with pytest.raises(OSError, match="No space"):
            file.write(b"lost")
    file.close()


def test_beside(tmp_path):
    path = tmp_path / "a.b.mcap"
    assert path_beside(path) == tmp_path / "a.b_1.mcap"
    (tmp_path / "a.b_1.mcap").touch()
    (tmp_path / "a.b_2_0.mcap").touch()
    assert path_beside(path) == tmp_path / "a.b_3.mcap"
    assert path_beside(tmp_path / "bag") == tmp_path / "bag_1"
