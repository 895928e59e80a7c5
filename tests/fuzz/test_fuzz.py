"""The fuzz target on its seeds and for a little while; and the fuzzer itself, on things that are broken."""

import subprocess
import sys
from pathlib import Path
from random import Random

import damage
import pytest
from effort import every, examples

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import fuzz  # noqa: E402  the folder is no package
import fuzz_engine  # noqa: E402
import fuzz_shapes  # noqa: E402
import fuzz_targets  # noqa: E402


@pytest.mark.each(3)
@pytest.mark.parametrize("name", fuzz_targets.TARGETS)
def test_seeds_and_what_once_broke(name):
    """A seed that shows nothing of its own is a seed too many; a target that sees no difference is blind."""
    found = [
        fuzz_engine.execute(name, fuzz_targets.TARGETS[name], data) for data in every(3, fuzz.seeds(name))
    ]
    assert [shown.report for shown in found if isinstance(shown, fuzz_engine.Finding)] == []
    assert len(set(found)) >= min(len(found) // 3, 5)


@pytest.mark.long("diagnosis-150")
@pytest.mark.parametrize(
    ("name", "executions"),
    [
        ("packet", 700),
        ("frames", 700),
        ("capture", 500),
        ("recover", 300),
        ("mission", 500),
        ("message", 3000),
        ("session", 100),
        ("diagnosis", 150),
        ("definition", 1500),
        ("where", 800),
        ("structs", 300),
        ("elf", 60),
        ("scenario", 400),
        ("rosbag2", 200),
        ("doctor", 60),
        ("stream", 150),
        ("datagrams", 150),
        ("dictionary", 150),
        ("commands", 60),
    ],
)
def test_for_a_little_while(name, executions):
    """The same mutations each time, a sixtieth of them but in ``make long``; ``make fuzz`` tries others."""
    fuzzer = fuzz_engine.Fuzzer(name, fuzz_targets.TARGETS[name], fuzz.seeds(name), Random(name))
    for _ in range(examples(executions, 60)):
        fuzzer.step()
    assert [finding.report for finding in fuzzer.findings.values()] == []


def test_every_packet_kind_has_a_seed():
    names = {path.name for path in (fuzz.SEEDS / "packet").iterdir()}
    for msg_id in (0x800, 0x801, 0x803, 0x804, 0x805, 0x806, 0x808, 0x80A, 0x880, 0x881, 0x884, 0x8FA, 0x827):
        assert any(name.startswith(f"to_{msg_id:04x}_") for name in names), hex(msg_id)
    for msg_id in (0x1801, 0x1803, 0x1804, 0x1805, 0x1806, 0x1827, 0x1880, 0x1884, 0x18FA):
        assert any(name.startswith(f"ci_{msg_id:04x}_") for name in names), hex(msg_id)
    for kind in (0x00, 0x01, 0x02, 0x04, 0x07, 0xA0, 0xA2, 0x1829, 0x82A):
        assert any(name.startswith(f"sbn_{kind:04x}_") for name in names), hex(kind)
    assert {"sbn_announce", "sbn_legacy_header", "ci_extended_header", "to_short_header"} <= names


def broken(data):
    """Wrong in one place only: a third byte of 0x80 and more."""
    if len(data) > 2 and data[2] >= 0x80:
        raise IndexError(data[2])
    return len(data) > 4, bool(data and data[0] & 1)


def test_it_finds_what_is_broken_and_makes_it_small(tmp_path):
    fuzzer = fuzz_engine.Fuzzer("broken", broken, [b"abcdefgh" * 20], Random(1))
    for _ in range(500):
        fuzzer.step()
    (finding,) = fuzzer.findings.values()
    assert finding.key.startswith("IndexError-test_fuzz-")
    assert len(finding.data) == 3
    path = finding.save(tmp_path / "deep")
    assert path.read_bytes() == finding.data
    assert "IndexError" in path.with_suffix(".txt").read_text()
    assert fuzz.again([path], {"broken": broken}) == 1
    assert len(fuzzer.corpus) > 1


def test_what_hangs_is_a_finding(monkeypatch):
    monkeypatch.setattr(fuzz_engine, "HANG_S", 0.1)

    def hang(data):
        while True:
            pass

    shown = fuzz_engine.execute("hang", hang, b"")
    assert shown.key.startswith("HangError-")


def test_files_stay_files_while_their_records_change():
    """Of a chunk the size and the checksum follow, of packets the lengths."""
    random, kinds = Random(4), {"pcap", "pcapng", "mcap", "pcap_gz", "pcap_zst"}
    files = {name: (fuzz.SEEDS / "capture" / name).read_bytes() for name in kinds}
    others = [*files.values()]
    for name, data in files.items():
        changed = [fuzz_shapes.mutate(data, others, random, fuzz_engine.scrambled) for _ in range(60)]
        assert len({*changed}) > 30, name
        if name in {"pcap", "pcapng", "mcap"}:  # the first section of a pcapng may be gone
            assert sum(fuzz_shapes.shape(item) is not None for item in changed) > 40, name
    garbled = [fuzz_shapes.mutate(files["mcap"], [], random, fuzz_engine.scrambled) for _ in range(60)]
    assert sum(damage.plain_scan(data).total() > 0 for data in garbled) > 30
    assert fuzz_shapes.mutate(b"no file", [], random, fuzz_engine.scrambled) is None


@pytest.mark.parametrize("data", [b"", b"\x00", bytes(100)])
def test_mutations_differ_and_are_bounded(data):
    random = Random(3)
    made = [fuzz_engine.mutate(data, [b"other", b""], random) for _ in range(500)]
    assert len(set(made)) > 50
    assert max(map(len, made)) <= fuzz_engine.LONGEST


def test_time_is_shared():
    """Every target has its turns, by a clock that is an argument."""
    ticks = iter(range(10**6))
    fuzzers = [fuzz_engine.Fuzzer(name, len, [b"x"], Random(name)) for name in "abc"]
    fuzz_engine.fuzz(fuzzers, 3, clock=lambda: next(ticks) / 1000)
    counts = [item.executions for item in fuzzers]
    assert min(counts) > 100
    assert max(counts) - min(counts) <= max(counts) // 2


@pytest.mark.long
def test_the_command(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            HERE / "fuzz.py",
            "--no-atheris",
            "--seconds",
            "0.5",
            "--seed",
            "1",
            "--target",
            "message",
        ],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "for 0.5 s, --seed 1" in done.stdout
    assert done.stdout.endswith("\n0 findings\n")
