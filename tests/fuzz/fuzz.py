"""Feed garbage to every decoder: ``python tests/fuzz/fuzz.py --seconds 60 [--seed N] [--target NAME]``.

With atheris installed its coverage leads the way; without it, a small fuzzer in Python mutates the seeds.
What breaks is saved in ``tests/fuzz/findings``; ``fuzz.py FILE...`` runs such files again.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from pathlib import Path
from random import Random

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

import fuzz_engine

HERE = Path(__file__).parent
SEEDS = HERE / "seeds"
MOST_MEMORY = 4 << 30
BROKE = HERE / "broke"
"""Findings of the past: moved here once what they showed is mended."""


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
    return [path.read_bytes() for path in sorted([*(SEEDS / name).iterdir(), *BROKE.glob(f"{name}-*.bin")])]


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
    """Let atheris drive: target after target, each in a process of its own, which libFuzzer ends."""
    import os

    import atheris

    with atheris.instrument_imports(include=["edoras_tools"]):
        from fuzz_targets import TARGETS
    chosen = options.target or list(TARGETS)
    options.findings.mkdir(parents=True, exist_ok=True)
    broken = 0
    for name in chosen:
        child = os.fork()
        if child:
            broken += os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
            continue
        limits = [
            f"-max_total_time={max(int(options.seconds / len(chosen)), 1)}",
            f"-max_len={fuzz_engine.LONGEST}",
        ]
        if options.seed is not None:
            limits.append(f"-seed={options.seed or 1}")
        saved = f"-artifact_prefix={options.findings}/{name}-"
        corpus = options.findings / f"corpus-{name}"
        corpus.mkdir(exist_ok=True)
        atheris.Setup(["fuzz", *limits, saved, str(corpus), str(SEEDS / name)], TARGETS[name])
        atheris.Fuzz()
    return bool(broken)


if __name__ == "__main__":
    sys.exit(main())
