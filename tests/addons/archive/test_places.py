"""Captures on an S3 server are indexed as local ones; what goes wrong with a server is told in one line."""

from __future__ import annotations

import http.server
import logging
import subprocess
import sys
import threading
import urllib.request
from pathlib import Path
from types import SimpleNamespace

import pytest
from effort import LONG
from places import CAPTURES

from edoras_tools.addons.archive.index import TABLES, open_index
from edoras_tools.addons.archive.places import find_captures, listed_now
from edoras_tools.addons.archive.update import Update, bring_up_to_date
from edoras_tools.addons.archive.work import Task, examine_group, fingerprint
from edoras_tools.errors import CaptureError
from edoras_tools.pipelines.workbench import Settings

NAMES = ("a_rover", "b_arm_single", "e_ci_errors", "f_sbn_disconnect")
FRESH = {"skip_instance_cache": True}


@pytest.fixture(scope="module")
def server():
    """An S3 server: ``start``, ``stop``, and its ``url``; what it holds stays while it is stopped."""
    from moto.server import ThreadedMotoServer  # as s3fs, only where it is used: a second

    own = SimpleNamespace(server=None, port=0)

    def start():
        own.server = ThreadedMotoServer("127.0.0.1", own.port)
        own.server.start()
        own.port = own.server.get_host_and_port()[1]
        own.url = f"http://127.0.0.1:{own.port}"

    def stop():
        own.server.stop()

    logging.getLogger("werkzeug").setLevel(logging.CRITICAL)
    start()
    own.start, own.stop = start, stop
    yield own
    stop()


@pytest.fixture
def s3(server, monkeypatch, tmp_path):
    """The server with captures in a bucket, and ``files``, to write others."""
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "x")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")  # nobody outside is asked for keys
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setenv("AWS_ENDPOINT_URL", server.url)
    monkeypatch.setenv("HOME", str(tmp_path))
    server.forget = s3fs.S3FileSystem.clear_instance_cache
    server.forget()
    urllib.request.urlopen(f"{server.url}/moto-api/reset", data=b"").close()
    server.files = s3fs.S3FileSystem(**FRESH)
    server.files.mkdir("fleet")
    for name in NAMES:
        server.files.put_file(str(CAPTURES / f"{name}.pcap"), f"fleet/day 1/{name}.pcap")
    server.files.pipe_file("fleet/readme.txt", b"none")
    yield server
    server.forget()


@pytest.fixture(scope="module")
def scheduler():
    """The address of a scheduler with a worker, in this process."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=1,
        processes=False,
        protocol="tcp",
        host="127.0.0.1",
        dashboard_address=None,
        silence_logs=60,
    ) as made:
        yield made.scheduler_address


class Nothing(http.server.BaseHTTPRequestHandler):
    """A web server without files."""

    def do_HEAD(self):
        self.send_error(404)

    def do_GET(self):
        self.do_HEAD()

    def log_message(self, *arguments):
        pass


def archive(*arguments):
    command = [Path(sys.executable).with_name("edoras"), "archive", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    return done.returncode, done.stdout, done.stderr.splitlines()


def examined(urls):
    """What a worker says of captures, each by its name."""
    settings = Settings()
    rows = examine_group(Task(tuple((url, "") for url in urls), settings, fingerprint(settings))).rows
    return {row["capture"].rpartition("/")[2]: row for row in rows["captures"].to_pylist()}


def updated(index, root, scheduler):
    with open_index(index, write=True) as opened:
        return bring_up_to_date(opened, Update((root,), Settings(), scheduler=scheduler))


@pytest.mark.long
def test_a_bucket_is_indexed_as_a_folder(s3, scheduler, tmp_path):
    index = tmp_path / "x.duckdb"
    if LONG:
        command = ["s3://fleet", "--index", index, "--jobs", "1"]
        assert archive(*command) == (0, "", [f"{index}: 4 captures: 4 read, 0 unchanged"])
    else:  # without a cluster of its own
        assert updated(index, "s3://fleet", scheduler).read == 4
    local = examined([str(CAPTURES / f"{name}.pcap") for name in NAMES])
    with open_index(index) as opened:
        rows = {row["capture"]: row for row in opened.rows("SELECT * FROM captures")}
    assert set(rows) == {f"s3://fleet/day 1/{name}.pcap" for name in NAMES}
    for url, row in rows.items():
        same = row.keys() - {"capture", "version"}
        assert {name: row[name] for name in same} == {
            name: local[url.rpartition("/")[2]][name] for name in same
        }
    s3.files.pipe_file("fleet/day 1/a_rover.pcap", (CAPTURES / "b_arm_single.pcap").read_bytes())
    s3.files.put_file(str(CAPTURES / "b_arm_single.pcap"), "fleet/day 1/b_arm_single.pcap")
    s3.files.pipe_file("fleet/day 1/new.pcap", b"")
    s3.files.rm_file("fleet/day 1/e_ci_errors.pcap")
    report = updated(index, "s3://fleet/day 1/", scheduler)
    assert (report.listed, report.read, report.same, report.missing) == (4, 2, 0, 1)
    assert report.bad == ["s3://fleet/day 1/new.pcap: is empty; a capture has at least a header"]


@pytest.mark.long
def test_a_name_that_is_not_text_is_told(tmp_path):
    (tmp_path / "bad\udcff.pcap").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"bad\udcff\.pcap: its name is not UTF-8"):
        find_captures([str(tmp_path)])


def test_what_cannot_be_listed_is_told(s3, monkeypatch, tmp_path):
    def refused(root):
        s3.forget()
        with pytest.raises(CaptureError) as error:
            find_captures([root])
        assert "\n" not in str(error.value)
        return str(error.value)

    for root in ("s3://none", "s3://fleet/nothing", "s3://none/day 1/x.pcap"):
        assert refused(root) == f"{root}: there is no such file or folder; check the name"
    (found,) = find_captures(["s3://fleet/day 1/a_rover.pcap"])
    assert found == listed_now("s3://fleet/day 1/a_rover.pcap")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    monkeypatch.delenv("AWS_ACCESS_KEY_ID")
    line = refused("s3://fleet")
    assert line.startswith(
        "s3://fleet: cannot be listed: Unable to locate credentials; set AWS_ACCESS_KEY_ID and "
    )
    assert archive("s3://fleet", "--index", tmp_path / "x.duckdb") == (1, "", [f"edoras: {line}"])
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "x")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "x")
    s3.stop()
    assert refused("s3://fleet").startswith(
        "s3://fleet: cannot be listed: Could not connect to the endpoint URL"
    )
    s3.start()


@pytest.mark.long
def test_a_server_that_goes_away_is_told_and_the_next_update_goes_on(s3, scheduler, tmp_path):
    index = tmp_path / "x.duckdb"
    urls = [item.url for item in find_captures(["s3://fleet"])]
    s3.stop()
    rows = examined(urls)
    lines = told(rows)
    assert all(line.startswith("cannot be read: Could not connect to the endpoint URL") for line in lines[:3])
    assert lines[3:] == ["not asked for, as 3 others could not be fetched; index again"]
    with open_index(index, write=True) as opened:
        opened.replace([], [{"captures": TABLES["captures"].arrow(list(rows.values()))}])
    s3.start()
    report = updated(index, "s3://fleet", scheduler)
    assert (report.listed, report.read, report.bad) == (4, 4, [])
    with open_index(index) as opened:
        assert opened.ask("SELECT state, count(*) FROM captures GROUP BY ALL") == [("whole", 4)]


def told(rows):
    """Why captures are unreadable, without their names."""
    assert {row["state"] for row in rows.values()} == {"unreadable"}
    return [row["error"].partition(".pcap: ")[2] for row in rows.values()]


def test_a_web_server_that_goes_away_is_told():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Nothing) as server:
        root = f"http://127.0.0.1:{server.server_port}"
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        found = examined([f"{root}/{number}.pcap" for number in range(5)])
        server.shutdown()
        thread.join()
    assert told(found) == 5 * ["cannot be read: it is no longer there"]
    lines = told(examined([f"{root}/{number}.pcap" for number in range(5)]))
    assert all(line.startswith("cannot be read: Connect call failed ('127") for line in lines[:3])
    assert lines[3:] == 2 * ["not asked for, as 3 others could not be fetched; index again"]
    with pytest.raises(CaptureError, match="/: cannot be listed: Connect call failed"):
        find_captures([f"{root}/"])
