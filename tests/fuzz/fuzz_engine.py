"""A small fuzzer: mutate what showed something new, keep what shows something new again, save what breaks."""

from __future__ import annotations

import gc
import hashlib
import signal
import struct
import time
import traceback
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import fuzz_shapes

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Iterator
    from random import Random

LONGEST = 1 << 16
HANG_S = 10
_TELLING = (0, 1, 2, 4, 7, 8, 11, 16, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000)
_WIDTHS = ("B", "<H", ">H", "<I", ">I", "<Q", ">Q")


class HangError(Exception):
    """An input took too long."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What broke: where, and the bytes that did it."""

    target: str
    key: str
    data: bytes
    report: str

    @property
    def name(self) -> str:
        return f"{self.target}-{self.key}-{hashlib.sha256(self.data).hexdigest()[:8]}"

    def save(self, folder: Path) -> Path:
        """Write the bytes, and the traceback beside them."""
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{self.name}.bin"
        path.write_bytes(self.data)
        path.with_suffix(".txt").write_text(self.report, encoding="utf-8")
        return path


@contextmanager
def _watched(seconds: int) -> Iterator[None]:
    """Raise ``HangError`` in what computes longer, however busy the machine; in the main thread only."""

    def ring(_number: int, _frame: object) -> None:
        raise HangError(f"still busy after {seconds} s")

    before = signal.signal(signal.SIGVTALRM, ring)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def execute(name: str, target: Callable[[bytes], Hashable], data: bytes) -> Hashable | Finding:
    """Return the behaviour that bytes show, or what broke."""
    try:
        with _watched(HANG_S):
            return target(data)
    except (Exception, RecursionError) as error:  # noqa: BLE001  any of them is a finding
        frame = traceback.extract_tb(error.__traceback__)[-1]
        key = f"{type(error).__name__}-{Path(frame.filename).stem}-{frame.lineno}"
        return Finding(name, key, data, traceback.format_exc())
    finally:
        gc.collect(1)  # what decodes refers to itself: megabytes in few objects, which would be let stand


def mutate(data: bytes, others: list[bytes], random: Random) -> bytes:
    """Return bytes that differ a little, or in one place a lot; of a file also in its records."""
    shaped = fuzz_shapes.mutate(data, others, random, scrambled) if random.random() < 0.5 else None
    return (scrambled(data, others, random) if shaped is None else shaped)[:LONGEST]


def scrambled(data: bytes, others: list[bytes], random: Random) -> bytes:
    """Return bytes that differ a little, or in one place a lot, whatever they are."""
    made = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 3, 6))):
        place = random.randrange(len(made) + 1)
        match random.randrange(8):
            case 0 if made:
                made[place % len(made)] ^= 1 << random.randrange(8)
            case 1 if made:
                made[place % len(made)] = random.randrange(256)
            case 2:
                width = random.choice(_WIDTHS)
                value = random.choice((*_TELLING, len(made), len(made) - place))
                value = value if random.random() < 0.9 else -value
                mask = (1 << 8 * struct.calcsize(width)) - 1
                packed = struct.pack(width, value & mask)
                made[place : place + len(packed)] = packed
            case 3:
                del made[place : place + random.choice((1, 2, 4, 8, 100))]
            case 4:
                made[place:place] = random.randbytes(random.choice((1, 2, 4, 8, 40)))
            case 5:
                del made[place:]
            case 6:
                other = random.choice(others or [data])
                start = random.randrange(len(other) + 1)
                made[place:] = other[start:]
            case 7:
                size = random.choice((4, 8, 16, 64))
                made[place:place] = made[max(place - size, 0) : place] * random.choice((1, 2, 50))
    return bytes(made)


@dataclass(slots=True)
class Fuzzer:
    """One target under way.

    Attributes:
        corpus: what showed something new, seeds first.
        findings: what broke, by where it did.
    """

    name: str
    target: Callable[[bytes], Hashable]
    corpus: list[bytes]
    random: Random
    executions: int = 0
    behaviours: set[Hashable] = field(default_factory=set)
    findings: dict[str, Finding] = field(default_factory=dict)

    def seed(self) -> None:
        """Run the corpus itself."""
        for data in self.corpus[:]:
            self.behaviours.add(self._run(data))

    def step(self) -> None:
        """Try one mutation."""
        data = mutate(self.random.choice(self.corpus), self.corpus, self.random)
        shown = self._run(data)
        if shown not in self.behaviours:
            self.behaviours.add(shown)
            self.corpus.append(data)

    def _run(self, data: bytes) -> Hashable:
        self.executions += 1
        shown = execute(self.name, self.target, data)
        if isinstance(shown, Finding):
            if shown.key not in self.findings:
                self.findings[shown.key] = self._smaller(shown)
            return shown.key
        return shown

    def _smaller(self, finding: Finding, tries: int = 400) -> Finding:
        """Leave out what the finding does not need."""
        size = max(len(finding.data) // 2, 1)
        while size and tries > 0:
            for start in range(0, len(finding.data), size):
                tries -= 1
                data = finding.data[:start] + finding.data[start + size :]
                shown = execute(self.name, self.target, data) if tries > 0 else None
                if isinstance(shown, Finding) and shown.key == finding.key:
                    finding = shown
                    break
            else:
                size //= 2
        return finding


def fuzz(fuzzers: list[Fuzzer], seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
    """Give each target the same time, in turns."""
    end = clock() + seconds
    for fuzzer in fuzzers:
        fuzzer.seed()
    while (now := clock()) < end:
        share = min((end - now) / len(fuzzers), 1.0)
        for fuzzer in fuzzers:
            turn = clock() + share
            while clock() < turn:
                fuzzer.step()
