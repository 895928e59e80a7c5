"""An index is what ``info`` and ``doctor`` say of each capture, however it was made and stopped."""

from __future__ import annotations

import functools
import http.server
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import duckdb
import pytest
from distributed import LocalCluster
from distributed.scheduler import KilledWorker
from effort import LONG
from places import CAPTURES, MISSIONS

from edoras_tools.addons.archive import update, work
from edoras_tools.addons.archive.index import TABLES, open_index
from edoras_tools.addons.archive.places import find_captures
from edoras_tools.addons.archive.update import Update, UpdateReport, _Run, bring_up_to_date
from edoras_tools.addons.archive.views import ArchiveSpan, list_captures, list_losses
from edoras_tools.addons.archive.work import Task, examine_group, fingerprint
from edoras_tools.errors import CaptureError, ConfigError
from edoras_tools.pipelines.capture.info import inspect
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings, open_files

SETTINGS = Settings([MISSIONS / "rover_ground.yaml"])
ROVER = CAPTURES / "a_rover.pcap"
NAMES = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")
SMALL = ("a_rover", "b_arm_single")
LOST = 92 + 18 + 28


@pytest.fixture(scope="module")
def scheduler():
    """The address of a scheduler for all tests; its two workers are processes where they are to be killed."""
    with LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=LONG,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0" if LONG else None,
        silence_logs=60,
    ) as made:
        yield made.scheduler_address


@pytest.fixture
def folder(tmp_path):
    """A folder with the beginnings of two captures: what is asked of it is not what they hold."""
    for name in SMALL:
        data, end = (CAPTURES / f"{name}.pcap").read_bytes(), 24
        for _ in range(400):
            end += 16 + int.from_bytes(data[end + 8 : end + 12], "little")
        (tmp_path / f"{name}.pcap").write_bytes(data[:end])
    return tmp_path


@pytest.fixture(scope="module")
def made(updated):
    """The index of four captures, which is only read."""
    with TemporaryDirectory() as folder:
        index = Path(folder) / "x.duckdb"
        done = updated(index, *(CAPTURES / f"{name}.pcap" for name in NAMES))
        assert (done.report.listed, done.report.read, done.report.bad) == (4, 4, [])
        yield index


@pytest.fixture(scope="module")
def updated(scheduler):
    """A function: bring an index up to date; returns the report, and all its tables."""

    def run(index, *roots, settings=SETTINGS, progress=None, **options):
        told = []
        with open_index(index, write=True) as opened:
            update = Update(tuple(map(str, roots)), settings, scheduler=scheduler, **options)
            report = bring_up_to_date(opened, update, progress, told.append)
        return SimpleNamespace(report=report, told=told, tables=contents(index))

    return run


def contents(index):
    """Every row of every table of an index, in an order of their own."""
    with duckdb.connect(str(index), read_only=True) as opened:
        return {name: sorted(opened.execute(f"SELECT * FROM {name}").fetchall(), key=repr) for name in TABLES}


def rows(index, sql):
    with duckdb.connect(str(index), read_only=True) as opened:
        return opened.execute(sql).fetchall()


@pytest.mark.long
def test_it_says_what_info_and_doctor_say(made):
    index = made
    for name in NAMES:
        path = CAPTURES / f"{name}.pcap"
        source = open_files([path])
        info = inspect(source, SETTINGS.workbench(source.info)).summary()
        source = open_files([path])
        doctor = examine(source, SETTINGS.workbench(source.info)).summary()
        of = f"FROM {{}} WHERE capture = '{path}'"
        both = {**doctor, **info, "state": "whole"}
        names = (
            "kind",
            "datagrams",
            "skipped",
            "start_ns",
            "end_ns",
            "lost",
            "superseded",
            "unaccounted",
            "state",
        )
        found = rows(index, f"SELECT {', '.join(names)} {of.format('captures')}")
        assert found == [tuple(both[item] for item in names)]
        for table, wanted in (("routes", info["routes"]), ("streams", doctor["routes"])):
            names = [item for item in TABLES[table].names if item in wanted[0]]
            found = rows(index, f"SELECT {', '.join(names)} {of.format(table)}")
            assert sorted(found, key=repr) == sorted(
                (tuple(row[item] for item in names) for row in wanted), key=repr
            )
        assert (
            dict(rows(index, f"SELECT finding, sum(datagrams)::INT {of.format('findings')} GROUP BY finding"))
            == info["findings"]
        )
        verdicts = [*doctor["verdicts"], *doctor["habits"]]
        assert sorted(
            rows(index, f"SELECT rule, severity, reason, lost {of.format('verdicts')}"), key=repr
        ) == sorted(
            ((item["rule"], item["severity"], item["reason"], item["lost"]) for item in verdicts), key=repr
        )
        assert sorted(row[0] for row in rows(index, f"SELECT text {of.format('warnings')}")) == sorted(
            {*info["warnings"], *doctor["warnings"]}
        )


def test_its_figures_add_up(made):
    index = made
    for table in ("outcomes", "losses", "balance"):
        sums = (
            f"SELECT capture, coalesce(sum({table}.lost), 0), any_value(captures.lost) "
            f"FROM captures LEFT JOIN {table} USING (capture) GROUP BY capture"
        )
        assert all(lost == own for _, lost, own in rows(index, sums)), table
    assert rows(index, "SELECT sum(lost) FROM captures") == [(LOST,)]
    odd = "came_in + duplicated <> came_out + lost + superseded + waiting + not_captured + unaccounted"
    assert rows(index, f"SELECT * FROM balance WHERE {odd}") == []
    assert rows(index, "SELECT count(*) FROM balance") != [(0,)]
    packets = "SELECT capture, sum(count)::INT FROM routes WHERE msg_id = '0x0808' GROUP BY ALL ORDER BY ALL"
    events = "SELECT capture, count(*) FROM events GROUP BY ALL ORDER BY ALL"
    assert rows(index, events) == rows(index, packets) != []
    (mission,) = set(rows(index, "SELECT file, bytes FROM missions"))
    assert mission[1] == (MISSIONS / "rover_ground.yaml").stat().st_size


@pytest.mark.long
def test_only_what_is_new_or_changed_is_read(folder, updated):
    index = folder / "x.duckdb"
    first = updated(index, folder)
    again = updated(index, folder)
    assert (again.report.read, again.tables) == (0, first.tables)
    os.utime(folder / "a_rover.pcap", ns=(1, 1))
    touched = updated(index, folder)
    assert (touched.report.read, touched.report.same) == (0, 1)
    assert updated(index, folder).report.same == 0
    shutil.copy(folder / "a_rover.pcap", folder / "b_arm_single.pcap")
    shutil.copy(folder / "a_rover.pcap", folder / "new.pcap")
    changed = updated(index, folder)
    assert (changed.report.read, changed.report.listed) == (2, 3)
    assert rows(index, "SELECT datagrams FROM captures") == [(400,)] * 3
    assert rows(index, "SELECT DISTINCT lost > 0 FROM captures") == [(True,)]
    afresh = updated(folder / "y.duckdb", folder)
    assert afresh.tables == changed.tables
    assert updated(index, folder, again=True).report.read == 3


@pytest.mark.long
def test_other_settings_read_all_again(folder, updated):
    index = folder / "x.duckdb"
    updated(index, folder)
    plain = updated(index, folder, settings=Settings())
    assert plain.report.read == 2
    assert rows(index, "SELECT count(*) FROM missions") == [(0,)]
    assert updated(folder / "y.duckdb", folder, settings=Settings()).tables == plain.tables


@pytest.mark.long
def test_what_is_no_longer_there_is_marked_or_forgotten(folder, updated):
    index = folder / "x.duckdb"
    updated(index, folder)
    (folder / "a_rover.pcap").rename(folder / "away")
    away = updated(index, folder)
    assert (away.report.missing, away.report.listed) == (1, 1)
    assert rows(index, "SELECT parse_filename(capture) FROM captures WHERE gone") == [("a_rover.pcap",)]
    (folder / "away").rename(folder / "a_rover.pcap")
    updated(index, folder)
    assert rows(index, "SELECT count(*) FROM captures WHERE gone") == [(0,)]
    (folder / "a_rover.pcap").unlink()
    updated(index, folder / "b_arm_single.pcap", forget=True)
    assert rows(index, "SELECT count(*) FROM captures") == [(2,)], "it is not below what was named"
    updated(index, folder, forget=True)
    for table in TABLES:
        assert rows(index, f"SELECT count(*) FROM {table} WHERE capture LIKE '%a_rover%'") == [(0,)]


def test_what_cannot_be_read_stops_nothing(folder, updated):
    whole = ROVER.read_bytes()
    (folder / "cut.pcap").write_bytes(whole[: len(whole) // 2])
    (folder / "empty.pcap").write_bytes(b"")
    (folder / "text.mcap").write_text("hello")
    os.mkfifo(folder / "pipe.pcap")
    (folder / "nowhere.pcap").symlink_to(folder / "nothing")
    index = folder / "x.duckdb"
    done = updated(index, folder)
    assert (done.report.listed, done.report.read) == (5, 5)
    assert [line.partition(": ")[0] for line in done.report.bad] == [
        str(folder / name) for name in ("cut.pcap", "empty.pcap", "text.mcap")
    ]
    states = dict(rows(index, "SELECT parse_filename(capture), state FROM captures"))
    assert states == {
        **{f"{name}.pcap": "whole" for name in SMALL},
        "cut.pcap": "cut",
        "empty.pcap": "unreadable",
        "text.mcap": "unreadable",
    }
    assert rows(index, "SELECT datagrams FROM captures WHERE state = 'cut'")[0][0] > 800
    again = updated(index, folder)
    assert (again.report.read, again.report.bad) == (0, done.report.bad), "told again, and not read again"


@pytest.mark.long
def test_a_file_that_changes_while_it_is_read_has_no_rows(folder, updated, monkeypatch):
    path = folder / "a_rover.pcap"
    task = Task(((str(path), ""),), SETTINGS, fingerprint(SETTINGS))
    read = work._read

    def grown(*arguments):
        found = read(*arguments)
        with path.open("ab") as file:
            file.write(b"\0")
        return found

    monkeypatch.setattr(work, "_read", grown)
    done = examine_group(task)
    assert list(done.rows) == ["captures"]
    (row,) = done.rows["captures"].to_pylist()
    assert (row["state"], row["datagrams"], row["lost"]) == ("changing", None, None)
    assert "changed while it was read" in row["error"]
    index = folder / "x.duckdb"
    with open_index(index, write=True) as opened:
        opened.replace([], [done.rows])
    assert updated(index, folder).report.read == 2, "the next update reads it"


@pytest.mark.long
def test_captures_of_a_group_are_read_as_if_alone(tmp_path):
    """Also after a recording that carries missions of its own."""
    source, own = open_files([ROVER]), tmp_path / "own.mcap"
    record(source, SETTINGS.workbench(source.info), Target(own))
    files = [own, *(CAPTURES / f"{name}.pcap" for name in (*NAMES, "a_rover"))]
    plain = Settings()
    mark = fingerprint(plain)
    together, *alone = (
        examine_group(Task(tuple((str(path), "") for path in some), plain, mark)).rows
        for some in (files, *([path] for path in files))
    )
    assert set(together) == {name for own in alone for name in own}
    assert together["missions"]["capture"].to_pylist() == [str(own)]
    for name, rows in together.items():
        assert rows.to_pylist() == [
            row for other in alone if name in other for row in other[name].to_pylist()
        ], name


def test_a_worker_with_another_mission_is_refused(folder, updated, monkeypatch):
    assert "other mission files" in examine_group(Task(((str(ROVER), ""),), SETTINGS, "other")).misfit
    monkeypatch.setattr("edoras_tools.addons.archive.update.fingerprint", lambda _settings: "other")
    with pytest.raises(ConfigError, match="a worker sees other mission files"):
        updated(folder / "x.duckdb", folder)


class Hook:
    """A progress that does something when the first rows are written."""

    def __init__(self, act):
        self.act = act

    def step(self, _what, done, _of):
        if done:
            self.act, act = (lambda: None), self.act
            act()


@pytest.mark.long
def test_a_lost_worker_changes_nothing(folder, updated, scheduler):
    whole = updated(folder / "x.duckdb", folder)
    with update.workers(0, scheduler, most=1) as client:
        before = client.run(os.getpid)
        hook = Hook(lambda: os.kill(next(iter(before.values())), signal.SIGKILL))
        found = updated(folder / "y.duckdb", folder, progress=hook)
        client.wait_for_workers(2)
    assert found.tables == whole.tables
    assert found.report.read == 2


@pytest.mark.long
def test_progress_is_shown_before_the_first_capture_is_read_and_after_the_last(folder, updated):
    steps = []
    updated(folder / "z.duckdb", folder, progress=SimpleNamespace(step=lambda *item: steps.append(item)))
    assert (steps[0], steps[-1]) == (("captures", 0, 2), ("captures", 2, 2))
    assert [done for _, done, _ in steps] == sorted(done for _, done, _ in steps)


def test_what_loses_workers_is_read_alone_then_listed(folder):
    """A group in which workers die is divided; the capture that did it is listed."""
    died = KilledWorker("task", SimpleNamespace(), 3)
    with open_index(folder / "x.duckdb", write=True) as index:
        report = UpdateReport(unfinished=2)
        run = _Run(index, SimpleNamespace(), report, set(), print)
        waiting = []
        several = Task((("/one.pcap", ""), ("/two.pcap", "")), SETTINGS, "x")
        run._tasks["a"] = several
        run._write([SimpleNamespace(key="a", status="error", exception=lambda: died)], waiting)
        assert [item.captures for item in waiting] == [(several.captures[0],), (several.captures[1],)]
        run._tasks["b"] = waiting[0]
        run._write([SimpleNamespace(key="b", status="error", exception=lambda: died)], waiting)
        ((url, state, error),) = index.ask("SELECT capture, state, error FROM captures")
    assert (url, state, report.read, report.unfinished) == ("/one.pcap", "unreadable", 1, 1)
    assert error == "/one.pcap: cannot be read: 4 workers were lost with it, perhaps out of memory"


KILLED = """
import os, signal, sys
from pathlib import Path
from edoras_tools.addons.archive.index import open_index
from edoras_tools.addons.archive.update import Update, bring_up_to_date
from edoras_tools.pipelines.workbench import Settings

class Progress:
    def step(self, what, done, of):
        if done:
            os.kill(os.getpid(), signal.SIGKILL)

index, scheduler, folder, mission = sys.argv[1:]
with open_index(Path(index), write=True) as opened:
    bring_up_to_date(opened, Update((folder,), Settings([Path(mission)]), scheduler=scheduler), Progress())
"""


@pytest.mark.long
def test_killed_it_goes_on(folder, updated, scheduler):
    index = folder / "x.duckdb"
    arguments = [index, scheduler, folder, MISSIONS / "rover_ground.yaml"]
    done = subprocess.run([sys.executable, "-c", KILLED, *map(str, arguments)], check=False, timeout=300)
    assert done.returncode == -signal.SIGKILL
    (count,) = rows(index, "SELECT count(*) FROM captures")[0]
    assert 1 <= count <= 2
    resumed = updated(index, folder)
    assert resumed.report.read == 2 - count
    assert resumed.tables == updated(folder / "y.duckdb", folder).tables


def test_rows_that_cannot_be_written_leave_the_old_ones(made, tmp_path):
    index, url = tmp_path / "x.duckdb", str(CAPTURES / "a_rover.pcap")
    shutil.copy(made, index)
    before = contents(index)
    good = TABLES["captures"].arrow([{"capture": url}])
    bad = good.rename_columns(["nothing", *good.column_names[1:]])
    with pytest.raises(CaptureError, match="cannot be written"), open_index(index, write=True) as opened:
        opened.replace([url], [{"routes": TABLES["routes"].arrow([]), "captures": bad}])
    assert contents(index) == before


FULL = """
import resource, signal, sys
from pathlib import Path
from edoras_tools.errors import CaptureError
from edoras_tools.addons.archive.index import TABLES, open_index

path = Path(sys.argv[1])
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
limit = path.stat().st_size + 16384
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
try:
    with open_index(path, write=True) as opened:
        for number in range(3000):
            rows = [{"capture": str(number), "text": f"{number} {place} {'x' * 200}"} for place in range(50)]
            opened.replace([], [{"warnings": TABLES["warnings"].arrow(rows)}])
            print(number, flush=True)
except CaptureError as error:
    print(error)
"""


@pytest.mark.long
def test_a_full_disk_is_told_and_leaves_an_index(tmp_path):
    """The disk is a limit of a file's size, to which DuckDB comes while it commits."""
    index = tmp_path / "x.duckdb"
    with open_index(index, write=True):
        pass
    done = subprocess.run(
        [sys.executable, "-c", FULL, str(index)], capture_output=True, text=True, check=True, timeout=300
    )
    *numbers, told = done.stdout.splitlines()
    assert told.startswith(f"{index}: cannot be written: ")
    assert 1 < len(numbers) < 3000
    found = rows(index, "SELECT capture, count(*) FROM warnings GROUP BY ALL")
    assert sorted(found) == sorted((number, 50) for number in numbers), "complete, or not there"


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


@pytest.fixture
def web(folder):
    """The address of a web server with the captures."""
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.long
def test_captures_at_a_url_are_indexed_as_local_ones(folder, updated, web):
    local = updated(folder / "x.duckdb", folder)
    remote = updated(folder / "y.duckdb", f"{web}/")
    assert (remote.report.read, remote.report.bad) == (2, [])
    for name, own in TABLES.items():
        some = [item.name for item in own.columns if item.name not in {"capture", "version", "text"}]
        kept = [own.names.index(item) for item in some]
        one, two = (
            sorted((tuple(row[place] for place in kept) for row in found.tables[name]), key=repr)
            for found in (local, remote)
        )
        assert one == two, name
    assert [row[0] for row in remote.tables["captures"]] == [f"{web}/{name}.pcap" for name in sorted(SMALL)]
    assert updated(folder / "y.duckdb", f"{web}/").report.read == 0
    os.utime(folder / "a_rover.pcap", (1, 1))
    assert updated(folder / "y.duckdb", f"{web}/").report.same == 1
    assert updated(folder / "z.duckdb", f"{web}/a_rover.pcap").report.read == 1


@pytest.mark.parametrize(
    ("root", "told"),
    [
        ("nowhere", "nowhere: there is no such file or folder; check the name"),
        ("nope://x", "nope://x: cannot be listed: Protocol not known: nope"),
        ("http://127.0.0.1:1/", "http://127.0.0.1:1/: "),
    ],
)
def test_a_place_that_cannot_be_listed(root, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(CaptureError) as error:
        find_captures([root])
    assert str(error.value).startswith(told)
    assert "\n" not in str(error.value)


def refused(folder, address):
    """Why an update with a scheduler is refused; nothing is written."""
    update = Update((str(folder),), SETTINGS, scheduler=address)
    with open_index(folder / "x.duckdb", write=True) as opened, pytest.raises(CaptureError) as error:
        bring_up_to_date(opened, update)
    assert rows(folder / "x.duckdb", "SELECT count(*) FROM captures") == [(0,)]
    return str(error.value)


def test_a_scheduler_that_does_not_answer_is_refused(folder, monkeypatch):
    monkeypatch.setattr(update, "_PATIENCE_S", 0.3)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        for address in ("tcp://127.0.0.1:1", "nonsense", f"tcp://127.0.0.1:{silent.getsockname()[1]}"):
            assert refused(folder, address).startswith(f"{address}: no dask scheduler answers there; ")


def test_a_worker_is_no_scheduler(folder, scheduler):
    with update.workers(0, scheduler, most=1) as client:
        worker = next(iter(client.nthreads()))
    assert refused(folder, worker).startswith(
        f"{worker}: is the address of a Worker, not of a dask scheduler"
    )


@pytest.mark.long
def test_a_lost_scheduler_is_told(folder, monkeypatch):
    lost = LocalCluster(n_workers=1, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=60)
    monkeypatch.setattr(update, "_PATIENCE_S", 0.5)
    watch = _Run._watch
    monkeypatch.setattr(_Run, "_watch", lambda run: (lost.close(), watch(run)))
    told = refused(folder, lost.scheduler_address)
    assert told == "the scheduler was lost; what was read is in the index: run the same again to go on"


def test_a_scheduler_without_workers_is_refused(folder, monkeypatch):
    monkeypatch.setattr(update, "_PATIENCE_S", 0.3)
    with LocalCluster(
        n_workers=0, host="127.0.0.1", dashboard_address="127.0.0.1:0", silence_logs=60
    ) as empty:
        address = empty.scheduler_address
        assert refused(folder, address).startswith(f"{address}: the scheduler has no worker; ")


@pytest.mark.long
def test_no_index_another_file_an_older_index_and_one_in_use(tmp_path):
    with (
        pytest.raises(CaptureError, match="there is no such index; make it"),
        open_index(tmp_path / "x.duckdb"),
    ):
        pass
    (tmp_path / "text").write_text("hello" * 1000)
    with (
        pytest.raises(CaptureError, match="is not an index that can be opened"),
        open_index(tmp_path / "text"),
    ):
        pass
    with duckdb.connect(str(tmp_path / "other")) as other:
        other.execute("CREATE TABLE a (b INT)")
    with pytest.raises(CaptureError, match="but no index of edoras archive"), open_index(tmp_path / "other"):
        pass
    with open_index(tmp_path / "old", write=True) as opened:
        opened.run("UPDATE about SET value = '0' WHERE name = 'shape'")
    with pytest.raises(CaptureError, match="is an index of version 0"), open_index(tmp_path / "old"):
        pass
    hold = "import duckdb, sys; c = duckdb.connect(sys.argv[1]); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", hold, str(tmp_path / "held")], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as held:
        held.stdout.readline()
        with (
            pytest.raises(CaptureError, match="another program is using the index"),
            open_index(tmp_path / "held", write=True),
        ):
            pass
        held.stdin.close()


def test_questions(made):
    with open_index(made) as opened:
        every = list_captures(opened, ArchiveSpan())
        middle = every[1]["start_ns"]
        assert [Path(row["capture"]).stem for row in every] == [
            "a_rover",
            "b_arm_single",
            "e_ci_errors",
            "f_sbn_disconnect",
        ]
        assert list_captures(opened, ArchiveSpan(until_ns=middle)) == every[:1]
        assert list_captures(opened, ArchiveSpan(since_ns=every[0]["end_ns"] + 1)) == every[1:]
        lost = list_losses(opened, ArchiveSpan())
        assert sum(row["lost"] for row in lost) == LOST
        early = ArchiveSpan(until_ns=middle)
        (drive,) = list_losses(opened, early, ("cmd_vel",), over=0.15)
        assert (drive["topic"], drive["sent"], drive["lost"], drive["causes"]) == (
            "/cmd_vel",
            600,
            92,
            ["limit"],
        )
        assert list_losses(opened, early, ("cmd_vel",), over=0.16) == []
        assert list_losses(opened, ArchiveSpan(), ("0x1827",)) == [
            row for row in lost if row["msg_id"] == "0x1827"
        ]
        assert list_losses(opened, ArchiveSpan(until_ns=every[0]["start_ns"])) == []


def test_many_small_captures_are_few_groups(tmp_path):
    from edoras_tools.addons.archive.places import ListedFile
    from edoras_tools.addons.archive.update import _tasks

    files = [ListedFile(f"/{number}", 1_000_000, "1") for number in range(1000)]
    files.append(ListedFile("/large", 1 << 40, "1"))
    tasks = _tasks(files, {}, SETTINGS, "x", 2)
    assert tasks[0].captures == (("/large", ""),)
    assert sorted(item for task in tasks for item in task.captures) == sorted(
        (item.url, "") for item in files
    )
    assert len(tasks) == 1 + -(-1000 // 16), "16 MiB each"
