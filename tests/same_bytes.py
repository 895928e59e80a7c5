"""Hashes of what the commands print and write, compared with those that are committed in ``same_bytes/``.

    python tests/same_bytes.py [--quick] [--update] [--texts DIR] [WORD ...]

A line of ``same_bytes/COMMAND.txt`` is a hash and the command line, as it is typed in the root of the
repository. Who changes an output updates its line, and says why in the commit. With ``--texts`` what was
hashed is written to a folder: ``diff -r`` of the folders of two versions shows what changed. WORD chooses the
command lines that contain it.

A hash is of the exit code, of standard output and error, and of every file that was written. Of files whose
bytes depend on libraries it is of their contents: MCAP and rosbag2 (chunks, compression), Parquet and Arrow.
Captures named ``emulated/`` are runs of the emulated cFS in simulated time, each a line of ``emulated.txt``.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import random
import shlex
import shutil
import sys
import tempfile
from collections import defaultdict
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

os.environ["OPENBLAS_NUM_THREADS"] = "1"  # as edoras does
ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests/support"))

import here  # noqa: E402
from mcap.stream_reader import StreamReader  # noqa: E402

from edoras_tools import __version__  # noqa: E402

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

HASHES = ROOT / "tests/same_bytes"
ENVIRONMENT = {
    "PATH": os.defpath,
    "LC_ALL": "C.UTF-8",
    "TZ": "UTC",
    "NO_COLOR": "1",
    "COLUMNS": "100",
    "LINES": "40",
    "OPENBLAS_NUM_THREADS": "1",
}
"""All that a command sees of whoever runs it."""
SEASON = "tests/captures/season3"
ROVER, ARM = ("rover_ground",), ("single_arm_ground",)
TWO_ROVERS = ("two_rovers_ground", "two_rovers_flight")
TWO_ARMS = ("two_arms_ground", "two_arms_flight")


class Run(NamedTuple):
    """A run of the emulated cFS.

    Attributes:
        scenario: of the emulator.
        seconds: how long it lasts, after cFS has booted.
        command_hz: commands per second and robot.
        seed: of the latencies, and of the malformed datagrams that come in between.
    """

    scenario: str
    seconds: int
    command_hz: float
    seed: int


RUNS = {
    "rover": Run("rover", 30, 12.0, 1),
    "two_rovers": Run("two-rovers", 20, 5.0, 2),
    "two_arms": Run("two-arms", 15, 9.0, 3),
}

CAPTURES: dict[str, tuple[str, ...]] = {
    "emulated/rover.pcap": ROVER,
    "emulated/two_rovers.pcap": TWO_ROVERS,
    "emulated/two_arms.pcap": TWO_ARMS,
    "samples/captures/a_rover.pcap": ROVER,
    "samples/captures/b_arm_single.pcap": ARM,
    "samples/captures/c1_tlm_rate_limit4.pcap.gz": ROVER,
    "samples/captures/d3_cpu1_cpu2.pcap.gz": TWO_ROVERS,
    "samples/captures/e_ci_errors.pcap": ROVER,
    "samples/captures/f_sbn_disconnect.pcap": TWO_ROVERS,
    "samples/cfs_files/cf_transfer.pcap": (),
    "samples/cfs_files/ci_errors.pcap.gz": (),
    "samples/cfs_files/events.log": (),
    "samples/cfs_files/run.pcap": (),
    "samples/cfs_files/sbn_tcp.pcap.gz": TWO_ROVERS,
    "samples/cfs_files/stored_events.dat": (),
    "samples/fprime/rover.pcap": (),
    "samples/recordings/robot.mcap": (),
    "samples/rtps/cyclone_receiver.pcap.gz": (),
    "samples/rtps/cyclone_sender.pcap.gz": (),
    "samples/rtps/fastdds_receiver.pcap.gz": (),
    "samples/rtps/fastdds_sender.pcap.gz": (),
    **{
        f"tests/captures/{name}.pcap.zst": ROVER
        for name in (
            *(
                "c3_mqueue10",
                "c4_cmd_rate",
                "n10_uplink_loss",
                "n12_two_hosts_flight",
                "n12_two_hosts_ground",
            ),
            *("n1_to_remove_all", "n3_cfs_restart", "n5_app_restarts", "p6b_extended_header"),
        )
    },
    "tests/captures/f2_sbn_announce_reload.pcap.zst": TWO_ROVERS,
    **{
        f"tests/captures/cfs7/{name}.pcap.zst": ()
        for name in (
            *(
                "apps_stopped",
                "bad_commands",
                "boots",
                "chaos",
                "clock_set",
                "counters_reset",
                "down_with_peer",
            ),
            *("long_commands", "network_bad", "no_ops", "processor_reset", "relay", "sbn_peer", "sbn_rates"),
            *("slow_app", "two_robots", "two_tcp"),
        )
    },
}
"""The captures, each with the missions that it is read with."""
CAPTURES |= {path.relative_to(ROOT).as_posix(): ROVER for path in sorted((ROOT / SEASON).glob("*.pcap.zst"))}
OPTIONS = {
    "samples/cfs_files/ci_errors.pcap.gz": ("--structs", "samples/structs/cfs_7.yaml"),
    "samples/fprime/rover.pcap": ("--structs", "samples/fprime/rover_dictionary.json"),
    "tests/captures/n10_uplink_loss.pcap.zst": ("--port", "ci:5234"),
    "tests/captures/cfs7/relay.pcap.zst": ("--port", "ci:5234"),
}
MESSAGES_ONLY = "samples/recordings/robot.mcap"
"""A recording of another tool: it has no datagrams."""
QUICK = ("samples/captures/b_arm_single.pcap", "samples/fprime/rover.pcap")
"""The captures of the quick part; of the rest of the lines it has all. What is in ``IN_PART`` it has of the
first one only."""

VIEWS = (
    *("sniff", "sniff -v", "sniff -V -n 120", "sniff -x -n 60", "sniff --json", "info", "info --json"),
    *("doctor", "doctor --json", "doctor --list-lost csv"),
)
RECORDINGS = ("-o out.mcap", "-o out.pcap", "-o out.pcapng", "--rosbag2 -o out")
TABLES = ("csv", "jsonl", "parquet", "arrow")
IN_PART = ("--rosbag2 -o out", "parquet", "arrow")
"""What takes long, and is made of the same rows as the others: of every third capture only."""
PACKETS = (2, 75)
BRIEF = (
    "sniff -v ",
    "info --json ",
    "doctor ",
    "record --jobs 1 -o out.mcap ",
    "export --jobs 1 --format csv ",
)
"""Of the captures of the third season, which are much alike."""
INJECTED = (
    *("noop ci", "noop to", "to-enable 127.0.0.1", "to-add 0x827 --limit 8", "to-remove 0x827"),
    *("--command 0x1806 0", "--command 0x1880 6 --hex 00112233"),
    f"/cmd_vel '{{linear: {{x: 0.5}}}}' -c {ROVER[0]}",
    f"/cmd_vel '{{linear: {{x: 0.5}}}}' -c {ROVER[0]} --hz 10 -n 50 --fault drop:0.2 --seed 7",
    f"/cmd_vel --every-field-random --seed 5 -n 20 -c {ROVER[0]}",
    f"/command_pose '{{position: {{z: 1}}}}' -c {ARM[0]} --checksum fix --sequence count",
    f"/robot_1/pose '{{}}' --to sbn --as 66:3 -c {TWO_ROVERS[0]} -c {TWO_ROVERS[1]}",
)
OTHERS = (
    *(f"info{json} samples/cfs_files/{name}" for json in ("", " --json") for name in (
        "performance.dat", "resets.log", "sbn_conf_tbl.tbl", "to_lab_sub.tbl"
    )),
    "export samples/cfs_files/performance.dat -o out.json",
    "sniff samples/cfs_files/run.pcap samples/cfs_files/resets.log samples/cfs_files/events.log -n 500",
    f"doctor --predict -c {ROVER[0]}",
    f"doctor --predict --json -c {TWO_ROVERS[0]} -c {TWO_ROVERS[1]}",
    "wireshark print",
    *(f"{command} -c {' -c '.join(names)}" for names in (ROVER, ARM, TWO_ROVERS, TWO_ARMS) for command in (
        "wireshark print", "xtce", "codegen -o out"
    )),
)  # fmt: skip


def lines(*, quick: bool = False) -> list[str]:
    """Return all command lines."""
    made = list(_others())
    for capture in QUICK if quick else CAPTURES:
        brief, part = capture.startswith(SEASON), quick and capture != QUICK[0]
        made += [line for line in _of_capture(capture, in_part=part) if not brief or line.startswith(BRIEF)]
    return sorted(made)


def _others() -> Iterator[str]:
    yield from map(_with_missions, OTHERS)
    for words in INJECTED:
        yield _with_missions(f"inject --dry-run --json {words}")


def _of_capture(capture: str, *, in_part: bool = False) -> Iterator[str]:
    whole = (*QUICK, "emulated/two_arms.pcap")
    in_part |= capture not in whole and list(CAPTURES).index(capture) % 3 != 0
    left_out = IN_PART if in_part else ()
    how = "".join(f" -c samples/missions/{name}.yaml" for name in CAPTURES[capture])
    how += "".join(f" {word}" for word in OPTIONS.get(capture, ()))
    if capture.startswith("emulated/"):
        yield f"emulated {Path(capture).stem}"
    for words in VIEWS:
        if capture != MESSAGES_ONLY or not words.startswith(("doctor", "sniff -x")):
            yield f"{words} {capture}{how}"
    for words in RECORDINGS:
        if words not in left_out and (capture != MESSAGES_ONLY or "pcap" not in words):
            yield f"record --jobs 1 {words} {capture}{how}"
    for form in (item for item in TABLES if item not in left_out):
        yield f"export --jobs 1 --format {form} -o out/ {capture}{how}"
    for number in PACKETS:
        yield f"decode {capture} {number}{how}"


def _with_missions(words: str) -> str:
    parts = shlex.split(words)
    for place, word in enumerate(parts):
        if word == "-c":
            parts[place + 1] = f"samples/missions/{parts[place + 1]}.yaml"
    return shlex.join(parts)


def emulate(name: str, path: Path) -> None:
    """Write a run of the emulated cFS, with malformed datagrams among its own, to a capture."""
    from edoras_tools.addons.lab.emulator import BOOT_NS, Simulation
    from edoras_tools.addons.lab.emulator.simulation import SimulatedSource
    from edoras_tools.cfs.profile import SimProfile
    from edoras_tools.pipelines.capture.record import Target, record
    from edoras_tools.pipelines.workbench import Settings
    from edoras_tools.units import SECOND

    run = RUNS[name]
    simulation = Simulation(
        SimProfile(seed=run.seed),
        run.scenario,
        start_ns=1_800_000_000 * SECOND - BOOT_NS,
        command_rate_hz=run.command_hz,
    ).boot()
    dice = random.Random(run.seed)
    for _ in range(2 * run.seconds):
        at_ns = simulation.now + dice.randrange(run.seconds * SECOND)
        endpoint = dice.choice([simulation.cfs.ci_endpoint, simulation.cfs.sbn_endpoint])
        simulation.feed(at_ns, endpoint, dice.randbytes(dice.choice([3, 7, 8, 11, 16, 900])))
    record(SimulatedSource(simulation, run.seconds * SECOND), Settings().workbench(), Target(path))


def outcome(line: str, folder: Path) -> bytes:
    """Run a command line, and return what is hashed of it.

    Args:
        line: the words behind ``edoras``, or ``emulated`` and the name of a run.
        folder: an empty one to run it in.
    """
    words = shlex.split(line)
    if words[0] == "emulated":
        return (folder.parent / f"{words[1]}.pcap").read_bytes()
    for name in ("samples", "tests"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "emulated").symlink_to(folder.parent)
    code, printed = _edoras(words, folder)
    parts = [f"exit code {code}\n".encode(), without_versions(printed)]
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            parts += [f"{path.relative_to(folder)}\n".encode(), contents(path)]
    return b"".join(parts)


def _edoras(words: Sequence[str], folder: Path) -> tuple[int, bytes]:
    """Run ``edoras`` in this process; return its exit code, and all that it printed, in order."""
    printed = folder.parent / f"{folder.name}.txt"
    os.environ.clear()
    os.environ.update({**ENVIRONMENT, "HOME": str(folder)})
    os.chdir(folder)
    sys.argv = ["edoras", *words]
    with printed.open("wb", buffering=0) as file:
        sys.stdout = sys.stderr = TextIOWrapper(file, encoding="utf-8", write_through=True)
        try:
            here.edoras()
        except SystemExit as end:
            code = int(end.code or 0)
        finally:
            sys.stdout, sys.stderr = sys.__stdout__, sys.__stderr__
            os.chdir(ROOT)
    data = printed.read_bytes()
    printed.unlink()
    return code, data


def contents(path: Path) -> bytes:
    """Return what is in a file, as far as this project decides it."""
    if path.suffix == ".mcap":
        return _text(_mcap(path))
    if path.suffix in {".parquet", ".arrow"}:
        return _text(_table(path))
    return without_versions(path.read_bytes())


def without_versions(text: bytes) -> bytes:
    """Replace the versions of this project and of Python where a text says them."""
    for name, version in (("edoras-tools", __version__), ("Python", platform.python_version())):
        text = text.replace(f"{name} {version}".encode(), f"{name} VERSION".encode())
    return text


def _text(rows: Iterable[object]) -> bytes:
    return "".join(f"{row}\n" for row in rows).encode()


def _mcap(path: Path) -> Iterator[str]:
    """Yield the records of a recording but for those that only say where others are, and how many."""
    names: dict[int, str] = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            match type(record).__name__:
                case "Schema":
                    names[-record.id] = record.name
                    row = f"schema {record.name} {record.encoding} {_digest(record.data)}"
                case "Channel":
                    names[record.id] = record.topic
                    row = f"channel {record.topic} {record.message_encoding} {names.get(-record.schema_id)}"
                    row += f" {sorted(record.metadata.items())}"
                case "Message":
                    row = f"{names[record.channel_id]} {record.sequence} {record.log_time}"
                    row += f" {record.publish_time} {_digest(record.data)}"
                case "Attachment":
                    row = f"attachment {record.name} {record.media_type} {record.log_time}"
                    row += f" {_digest(record.data)}"
                case "Metadata":
                    values = {**record.metadata, "version": ""}
                    row = f"metadata {record.name} {sorted(values.items())}"
                case _:
                    continue
            yield row


def _table(path: Path) -> Iterator[str]:
    """Yield what describes a table, and each column."""
    from pyarrow import ipc, parquet

    table = parquet.read_table(path) if path.suffix == ".parquet" else ipc.open_file(path).read_all()
    yield f"{table.num_rows} rows {sorted((table.schema.metadata or {}).items())}"
    for field in table.schema:
        values = repr(table[field.name].to_pylist()).encode()
        yield f"{field.name} {field.type} {field.nullable} {field.metadata} {_digest(values)}"


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:16]


def hash_of(line: str, place: Path, texts: Path | None) -> str:
    """Run a command line in a folder of its own below ``place``, and return its hash."""
    folder = Path(tempfile.mkdtemp(dir=place))
    try:
        data = outcome(line, folder)
    finally:
        shutil.rmtree(folder)
    if texts is not None:
        (texts / f"{line.replace('/', '_')[:180]} {_digest(line.encode())[:6]}").write_bytes(data)
    return _digest(data)


def hashes(chosen: Sequence[str], texts: Path | None = None) -> dict[str, str]:
    """Return the hash of each command line."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name in {Path(word).stem for line in chosen for word in line.split() if "emulated" in line}:
            if name in RUNS:
                emulate(name, place / f"{name}.pcap")
        # Each imports for itself what 30 lines take.
        with ProcessPoolExecutor(min(len(os.sched_getaffinity(0)), 1 + len(chosen) // 100)) as pool:
            found = pool.map(partial(hash_of, place=place, texts=texts), chosen, chunksize=4)
            return dict(zip(chosen, found, strict=True))


def committed(folder: Path) -> dict[str, str]:
    """Return the committed hash of each command line."""
    rows = [row.split(maxsplit=1) for path in folder.glob("*.txt") for row in path.read_text().splitlines()]
    return {line: digest for digest, line in rows}


def write(values: dict[str, str], folder: Path) -> None:
    """Write all hashes, those of a command to its file."""
    files = defaultdict(list)
    for line, digest in sorted(values.items()):
        files[line.split()[0]].append(f"{digest}  {line}\n")
    folder.mkdir(exist_ok=True)
    for path in folder.glob("*.txt"):
        path.unlink()
    for name, rows in files.items():
        (folder / f"{name}.txt").write_text("".join(rows), encoding="utf-8")


def main() -> int:
    """Compare, and print what differs; or update."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="two captures only")
    parser.add_argument("--update", action="store_true", help="write the hashes of today")
    parser.add_argument("--texts", type=Path, metavar="DIR", help="also write what is hashed")
    parser.add_argument("--hashes", type=Path, metavar="DIR", default=HASHES, help="where they are committed")
    parser.add_argument("words", nargs="*", metavar="WORD", help="only command lines that contain it")
    options = parser.parse_args()
    if options.texts:
        options.texts.mkdir(parents=True, exist_ok=True)
        options.texts = options.texts.resolve()
    chosen = [line for line in lines(quick=options.quick) if all(word in line for word in options.words)]
    before, today = committed(options.hashes), hashes(chosen, options.texts)
    differing = [line for line in chosen if today[line] != before.get(line)]
    obsolete = sorted(set(before) - set(lines()))
    if options.update:
        write(
            {line: digest for line, digest in {**before, **today}.items() if line not in obsolete},
            options.hashes,
        )
    for line in differing if before else ():
        print(f"{before.get(line, 'new'):16} -> {today[line]}  edoras {line}")
    for line in obsolete:
        print(f"no longer run: edoras {line}")
    print(f"{len(chosen):,} outputs, {len(differing):,} differ" + (", updated" if options.update else ""))
    return int(bool(differing or obsolete) and not options.update)


if __name__ == "__main__":
    sys.exit(main())
