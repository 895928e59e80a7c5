"""Whole commands on each input of ``many``, at N and at 4 N: processor time and memory.

As a script it prints the table of all cases, or of those whose name contains a WORD, and tells what is wrong:

    python tests/support/growth.py [WORD ...]
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import many

if TYPE_CHECKING:
    from collections.abc import Callable

EDORAS = Path(sys.executable).with_name("edoras")
MISSION = many.ROVER.parents[1] / "missions/rover_ground.yaml"
STARTED, SMALL, TIMES = 20, 1000, 4
MOST_TIMES, MOST_MIB = 6, 512
TRIES = 3
LEAST_S = 0.1
"""Less processor time than this cannot be compared."""
DRIVER = """
import json, os, sys
child = os.fork()
if not child:
    os.dup2(os.open(os.devnull, os.O_RDWR), 1)
    os.dup2(1, 2)
    os.execv(sys.argv[1], sys.argv[1:])
_, status, used = os.wait4(child, 0)
spent = used.ru_utime + used.ru_stime
print(json.dumps([os.waitstatus_to_exitcode(status), spent, used.ru_maxrss / 1024]))
"""
"""Runs a command from a small process: what a process used of memory counts that of its parent."""
COMMANDS = {
    many.pairs: ["info", "info --json", "sniff", "doctor", "check --init"],
    many.msg_ids: ["sniff --json", "record -o OUT.mcap", "doctor"],
    many.telemetry_pairs: [
        "info",
        "doctor",
        "report -o OUT.html",
        "compare FILE",
        "archive index --index OUT.duckdb",
    ],
    many.senders: ["info", "doctor", "check --init"],
    many.gaps: ["doctor", "export --format csv -o OUT/"],
    many.times: ["info", "doctor", "plot -o OUT.svg -c ROVER"],
    many.strangers: ["info"],
    many.fragments: ["info"],
    many.errors: ["info", "doctor"],
    many.robots: ["info"],
    many.peers: ["info", "doctor"],
    many.subscriptions: ["info", "doctor"],
    many.holes: ["info", "doctor"],
    many.connections: ["info"],
    many.web_topics: ["info", "export -o OUT/"],
    many.transactions: ["files -o OUT"],
    many.pieces: ["files -o OUT"],
    many.fprime: ["info", "doctor"],
    many.channels: ["info -c FRAMES"],
    many.writers: ["info", "doctor"],
    many.sample_pieces: ["info", "doctor"],
    many.interfaces: ["info"],
    many.packed: ["info"],
    many.damaged: ["recover -o OUT.pcap"],
    many.captures: ["info", "doctor"],
    many.topics: ["info", "check --init", "check", "export --format csv -o OUT/"],
    many.tiny_messages: ["info"],
    many.chunks: ["info", "recover -o OUT.mcap"],
    many.attachments: ["info", "recover -o OUT.mcap"],
    many.bag: ["info", "recover -o OUT.mcap"],
}
SUFFIXES = {many.interfaces: ".pcapng", many.packed: ".pcap.gz", many.captures: "", many.bag: ".db3"}
SUFFIXES |= dict.fromkeys((many.topics, many.tiny_messages, many.chunks, many.attachments), ".mcap")


class Case(NamedTuple):
    """An input, and a command line that gets it last; other words are put in by ``_used``."""

    make: Callable[[Path, int], None]
    line: str

    def __str__(self) -> str:
        return f"{self.make.__name__}-{self.line.replace(' ', '_').replace('/', '')}"


CASES = [Case(make, line) for make, lines in COMMANDS.items() for line in lines]


class Used(NamedTuple):
    """Exit code, processor time in s, and most memory in MiB of a command."""

    code: int
    cpu_s: float
    most_mib: float


class Growth(NamedTuple):
    """What a command used on hardly anything, which is what it takes to start, on N and on 4 N."""

    begun: Used
    less: Used
    more: Used

    @property
    def times(self) -> float:
        """How many times the processor time of N the other takes, without that of the start."""
        less, more = (item.cpu_s - self.begun.cpu_s for item in (self.less, self.more))
        return max(more, 0) / max(less, LEAST_S)

    @property
    def wrong(self) -> str:
        """What is wrong; empty if nothing is."""
        if self.more.code not in {0, 3}:
            return f"exit code {self.more.code}"
        if max(self.less.most_mib, self.more.most_mib) > MOST_MIB:
            return "memory"
        return "time" if self.times > MOST_TIMES else ""


def measure(case: Case, folder: Path) -> Growth:
    """Run a command on three sizes of its input, up to three times: a busy machine is no failure."""
    for number in range(TRIES):
        place = folder / str(number)
        place.mkdir()
        (place / "frames.yaml").write_text(many.FRAMES)
        grown = Growth(*(_used(case, place, count) for count in (STARTED, SMALL, TIMES * SMALL)))
        if not grown.wrong:
            break
    return grown


def _used(case: Case, folder: Path, count: int) -> Used:
    place = folder / str(count)
    place.mkdir()
    path = place / f"x{SUFFIXES.get(case.make, '.pcap')}"
    case.make(path, count)
    files = sorted(map(str, path.iterdir())) if path.is_dir() else [str(path)]
    names = {
        "FRAMES": str(folder / "frames.yaml"),
        "OUT/": f"{place / 'out'}/",
        "FILE": str(path),
        "ROVER": str(MISSION),
    }
    words = [str(names.get(word, word.replace("OUT", str(place / "out")))) for word in case.line.split()]
    if case.line == "check":
        files.append(str(place / "draft.yaml"))
        draft = [str(EDORAS), "check", "--init", "-q", *files[:-1], "-o", files[-1]]
        subprocess.run(draft, check=True, capture_output=True)
    run = [sys.executable, "-I", "-S", "-c", DRIVER, str(EDORAS), *words, *files]
    return Used(*json.loads(subprocess.run(run, capture_output=True, text=True, check=True).stdout))


def main(chosen: list[str]) -> int:
    """Print the table; return 1 if a case is wrong."""
    print(f"| input, command | s of CPU at {SMALL:,} | at {TIMES * SMALL:,} | times | MiB | |")
    print("|---|---|---|---|---|---|")
    broken = 0
    for case in CASES:
        if chosen and not any(word in str(case) for word in chosen):
            continue
        with tempfile.TemporaryDirectory() as name:
            grown = measure(case, Path(name))
        broken += bool(grown.wrong)
        figures = (
            f"{grown.less.cpu_s:.2f} | {grown.more.cpu_s:.2f} | {grown.times:.1f} | {grown.more.most_mib:.0f}"
        )
        print(f"| {case.make.__name__}, {case.line} | {figures} | {grown.wrong} |", flush=True)
    print(f"{broken} wrong; at most {MOST_TIMES} times, less the start, and {MOST_MIB} MiB")
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
