"""Feed garbage to every decoder: ``python tests/fuzz/fuzz.py --seconds 60 [--seed N] [--target NAME]``.

With atheris installed its coverage leads the way; without it, a small fuzzer in Python mutates the seeds.
What breaks is saved in ``tests/fuzz/findings``; ``fuzz.py FILE...`` runs such files again.
"""

from __future__ import annotations

import argparse
import importlib.util
import mmap
import os
import struct
import sys
import time
from pathlib import Path
from random import Random
from typing import TYPE_CHECKING, Any, NoReturn

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import fuzz_engine

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

HERE = Path(__file__).parent
SEEDS = HERE / "seeds"
MOST_MEMORY = 4 << 30
WALL_S = 300
"""What computes for ``fuzz_engine.HANG_S`` is a finding; what waits for so long ends the target."""
BROKE = HERE / "broke"
"""Findings of the past: moved here once what they showed is mended."""
WEIGHTS = {"commands": 12, "capture": 2, "recover": 2, "doctor": 2, "stream": 2}
"""Shares of the time, where they are not 1."""


def main(arguments: list[str] | None = None) -> int:
    """Run; returns 1 when something broke."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="*", type=Path, metavar="FILE", help="run these again: TARGET-*.bin")
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=None, help="of the mutations; by default the clock's")
    parser.add_argument("--target", action="append", metavar="NAME", help="only this one; repeatable")
    parser.add_argument("--findings", type=Path, default=HERE / "findings", metavar="DIR")
    parser.add_argument("--no-atheris", action="store_true", help="mutate in Python even where atheris is")
    options = parser.parse_args(arguments)
    if not options.files and not options.no_atheris and importlib.util.find_spec("atheris"):
        return with_atheris(options)
    import resource

    from fuzz_targets import TARGETS

    # Memory that an input asks for and the machine has not is a finding, not the end of the machine.
    resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))
    unknown = set(options.target or ()) - set(TARGETS)
    if unknown:
        parser.error(f"no target {', '.join(sorted(unknown))}; there are {', '.join(TARGETS)}")
    if options.files:
        return again(options.files, TARGETS)
    seed = time.time_ns() % 10**9 if options.seed is None else options.seed
    fuzzers = [
        fuzz_engine.Fuzzer(name, target, seeds(name), Random(f"{seed} {name}"))
        for name, target in TARGETS.items()
        if name in (options.target or TARGETS)
    ]
    print(f"fuzzing {', '.join(item.name for item in fuzzers)} for {options.seconds:g} s, --seed {seed}")
    fuzz_engine.fuzz(fuzzers, options.seconds)
    for item in fuzzers:
        print(f"{item.name:>8}: {item.executions:>8,} inputs, {len(item.behaviours):>5,} behaviours")
    found = [finding for item in fuzzers for finding in item.findings.values()]
    for finding in found:
        print(f"\n{finding.report}\n  saved: {finding.save(options.findings)}")
    print(f"{len(found)} findings")
    return bool(found)


def seeds(name: str) -> list[bytes]:
    """The committed inputs of a target: of every kind, and what once broke."""
    broke = sorted(BROKE.glob(f"{name}-*.bin"))
    if name == "commands":
        import fuzz_commands  # not before atheris looks at what is loaded

        return [*fuzz_commands.seeds(SEEDS), *(path.read_bytes() for path in broke)]
    return [path.read_bytes() for path in sorted([*(SEEDS / name).iterdir(), *broke])]


def again(files: list[Path], targets: dict) -> int:
    """Run saved inputs; the name of each begins with its target's."""
    broken = 0
    for path in files:
        name = path.name.partition("-")[0]
        name = name if name in targets else path.parent.name
        shown = fuzz_engine.execute(name, targets[name], path.read_bytes())
        if isinstance(shown, fuzz_engine.Finding):
            broken += 1
            print(f"{path}: {shown.report}")
        else:
            print(f"{path}: fine: {shown}")
    return bool(broken)


def with_atheris(options: argparse.Namespace) -> int:
    """Let atheris lead: target after target, each in a process of its own, which libFuzzer ends."""
    import atheris

    # Modules are loaded by commands too, when they run: the hook stays.
    with atheris.instrument_imports(include=["edoras_tools"], enable_loader_override=False):
        from fuzz_targets import TARGETS

        chosen = options.target or list(TARGETS)
        whole = sum(WEIGHTS.get(name, 1) for name in chosen)
        counts = mmap.mmap(-1, 16 * len(chosen))  # shared with the processes
        options.findings.mkdir(parents=True, exist_ok=True)
        broken = 0
        for place, name in enumerate(chosen):
            seconds = max(round(options.seconds * WEIGHTS.get(name, 1) / whole), 1)
            print(f"{name}: {seconds} s", flush=True)
            # Loads here what the target loads late: to instrument it may take longer than an input may.
            for data in seeds(name):
                fuzz_engine.execute(name, TARGETS[name], data)
            child = os.fork()
            if not child:
                _lead(atheris, name, TARGETS[name], seconds, options, (counts, 16 * place))
            code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            inputs, found = struct.unpack_from("<QQ", counts, 16 * place)
            print(f"{name:>10}: {inputs:>9,} inputs, {found} findings, exit code {code}", flush=True)
            broken += code != 0 or found > 0
    rows = [struct.unpack_from("<QQ", counts, 16 * place) for place in range(len(chosen))]
    print(f"{sum(row[0] for row in rows):,} inputs, {sum(row[1] for row in rows)} findings")
    return bool(broken)


def _lead(
    atheris: Any,
    name: str,
    target: Callable[[bytes], Hashable],
    seconds: int,
    options: argparse.Namespace,
    counts: tuple[mmap.mmap, int],
) -> NoReturn:
    """Fuzz one target until its time is over; a finding is saved, and the next input follows."""
    keys: set[str] = set()
    inputs = seeds(name)

    def one(data: bytes) -> None:
        shown = fuzz_engine.execute(name, target, data)
        if isinstance(shown, fuzz_engine.Finding) and shown.key not in keys:
            keys.add(shown.key)
            print(f"\n{shown.report}\n  saved: {shown.save(options.findings)}", flush=True)
        memory, at = counts
        struct.pack_into("<QQ", memory, at, struct.unpack_from("<Q", memory, at)[0] + 1, len(keys))

    def mutated(data: bytes, longest: int, seed: int) -> bytes:
        random = Random(seed)
        if random.random() < 0.5:
            return atheris.Mutate(data, longest)
        return fuzz_engine.mutate(data, inputs, random)[:longest]

    corpus, first = options.findings / f"corpus-{name}", options.findings / f"seeds-{name}"
    for folder in (corpus, first):
        folder.mkdir(exist_ok=True)
    for number, data in enumerate(inputs):
        (first / str(number)).write_bytes(data)
    limits = [f"-max_total_time={seconds}", f"-max_len={fuzz_engine.LONGEST}", "-len_control=0"]
    limits += [f"-artifact_prefix={options.findings}/{name}-", "-rss_limit_mb=3072", f"-timeout={WALL_S}"]
    if options.seed is not None:
        limits.append(f"-seed={options.seed or 1}")
    atheris.Setup(["fuzz", *limits, str(corpus), str(first)], one, custom_mutator=mutated)
    atheris.Fuzz()
    os._exit(0)


if __name__ == "__main__":
    sys.exit(main())
