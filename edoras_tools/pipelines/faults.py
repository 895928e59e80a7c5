"""Scenarios: which faults happen and when, from a YAML file and from the command line, as one plan.

::

    seed: 7
    profile: lunar              # a named link; see edoras proxy --help
    faults:
      - drop: 0.1               # the kind of fault, and its parameter
        msg_id: 0x1827          # which packets, and when
        from: 10s
        until: 20s
      - silence: 12s
        from: 30s
      - delay:200ms,to=cfs      # or written as for --fault

All errors of a file are reported at once, with file, line and key.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from edoras_tools.decode.filters.filter import Where
from edoras_tools.errors import ConfigError
from edoras_tools.io.frames.frame_batch import LINKTYPE_RAW
from edoras_tools.mission import tree
from edoras_tools.model import Datagram, Endpoint, Link
from edoras_tools.sessions.faults.machine import FaultPlan
from edoras_tools.sessions.faults.rules import (
    FAULT_KINDS,
    PROFILES,
    Rule,
    make_rule,
    parse_profile,
    parse_rule,
)

if TYPE_CHECKING:
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.sessions.faults.machine import Predicate


_SCENARIO_FORM: Final = "a scenario needs faults: with a list, e.g. - drop: 0.1"
_KEYS: Final = ("seed", "profile", "faults")
_LARGEST_SEED: Final = (1 << 64) - 1


def fault_plan(
    faults: Iterable[str] = (),
    profile: str | None = None,
    scenario: Path | None = None,
    seed: int | None = None,
) -> FaultPlan:
    """Make a plan from all sources of faults.

    Args:
        faults: rules, e.g. ``drop:0.1``; names of links; files that end in ``.yaml``.
        profile: a named link; its rules come first.
        scenario: a YAML file; its rules come last.
        seed: replaces the scenario's; 0 if neither is given.

    Raises:
        ConfigError: all errors at once.
    """
    rules: list[Rule] = []
    mistakes: list[str] = []
    usual, links, singles, files = 0, [profile], list[str](), [scenario]
    for text in faults:
        if text in PROFILES:
            links.append(text)
        elif text.endswith((".yaml", ".yml")):
            files.append(Path(text))
        else:
            singles.append(text)
    for read, texts in ((parse_profile, links), (lambda text: (parse_rule(text),), singles)):
        for text in filter(None, texts):
            try:
                rules += read(text)
            except ConfigError as error:
                mistakes += error.mistakes
    for path in filter(None, files):
        try:
            plan = load_scenario(path)
        except ConfigError as error:
            mistakes += error.mistakes
        else:
            rules, usual = [*rules, *plan.rules], plan.seed
    if mistakes:
        raise ConfigError(*mistakes)
    return FaultPlan(tuple(rules), usual if seed is None else seed)


def load_scenario(path: Path) -> FaultPlan:
    """Read a scenario.

    Raises:
        ConfigError: all errors at once, each with file, line and key.
    """
    report = tree.Mistakes(str(path))
    document = tree.read_document(
        path, report, _SCENARIO_FORM, one="a scenario is one document", instead="a readable file"
    )
    plan = _plan(document, report) if document is not None else FaultPlan()
    report.raise_all()
    return plan


def _plan(node: tree.Tree, report: tree.Mistakes) -> FaultPlan:
    rules: list[Rule] = []
    seed = 0
    keys: set[str] = set()
    for key, _, value in tree.named_entries(node, "", report, _SCENARIO_FORM, _KEYS):
        keys.add(key)
        if key == "seed":
            seed = _seed(value, report)
        elif key == "profile":
            rules += _profile(value, report)
        else:
            rules += _rules(value, report)
    if not keys & {"faults", "profile"} and not report.mistakes:
        report.mistake(node.line, "", f"it contains no fault; {_SCENARIO_FORM}")
    return FaultPlan(tuple(rules), seed)


def _seed(value: tree.Tree, report: tree.Mistakes) -> int:
    number = value.value if isinstance(value, tree.ScalarNode) else None
    if isinstance(number, int) and not isinstance(number, bool) and 0 <= number <= _LARGEST_SEED:
        return number
    report.mistake(value.line, "seed", f"a whole number is needed, from 0 to {_LARGEST_SEED}")
    return 0


def _profile(value: tree.Tree, report: tree.Mistakes) -> tuple[Rule, ...]:
    try:
        return parse_profile(value.text if isinstance(value, tree.ScalarNode) else "")
    except ConfigError as error:
        report.mistake(value.line, "profile", error.mistakes[0])
        return ()


def _rules(node: tree.Tree, report: tree.Mistakes) -> list[Rule]:
    if not isinstance(node, tree.SequenceNode):
        report.mistake(node.line, "faults", "a list is needed, e.g. - drop: 0.1")
        return []
    rules = []
    for index, item in enumerate(node.items):
        key = f"faults[{index}]"
        rule = None
        if isinstance(item, tree.MappingNode):
            rule = _rule(item, key, report)
        elif isinstance(item, tree.ScalarNode) and not item.missing:
            try:
                rule = parse_rule(item.text)
            except ConfigError as error:
                for text_ in error.mistakes:
                    report.mistake(item.line, key, text_)
        else:
            report.mistake(item.line, key, "a fault is needed, e.g. drop: 0.1")
        if rule is not None:
            rules.append(rule)
    return rules


def _rule(item: tree.MappingNode, key: str, report: tree.Mistakes) -> Rule | None:
    """Read a fault that is written as a mapping: one key must name the kind of fault."""
    words: list[tuple[str, str | None, int]] = []
    before = len(report.mistakes)
    for name_tree, value in item.entries:
        name = name_tree.text if isinstance(name_tree, tree.ScalarNode) else ""
        text = _text(value)
        if text is None or not name:
            report.mistake(
                value.line, f"{key}.{tree.printable(name)}", "a plain value or a list of them is needed"
            )
        else:
            words.append((name, text, name_tree.line))
    kinds = [word for word in words if word[0] in FAULT_KINDS]
    if len(report.mistakes) > before:
        return None
    if len(kinds) != 1:
        names = [name for name, _, _ in words]
        problem = (
            f"{' and '.join(name for name, _, _ in kinds)} in one fault; make them two"
            if kinds
            else f"none of {', '.join(names)} is a fault; {tree.suggestion(names[0], FAULT_KINDS)}"
            f"there are {', '.join(FAULT_KINDS)}"
        )
        report.mistake(item.line, key, problem)
        return None
    ((kind, setting, _),) = kinds
    options = [(name, text) for name, text, _ in words if name != kind]
    own = [("", setting)] if setting else []
    written = ",".join(
        [f"{kind}:{setting}" if setting else kind, *(f"{name}={text}" for name, text in options)]
    )
    rule, mistakes = make_rule(kind, [*own, *options], written)
    lines = {name: line for name, _, line in words}
    for name, problem in mistakes:
        report.mistake(lines.get(name or kind, item.line), f"{key}.{name or kind}", problem)
    return rule


def _text(value: tree.Tree) -> str | None:
    """Return a value as ``--fault`` writes it; None if it is not a value or a list of values."""
    if isinstance(value, tree.ScalarNode):
        return value.text
    if isinstance(value, tree.SequenceNode):
        texts = [item.text for item in value.items if isinstance(item, tree.ScalarNode)]
        return "|".join(texts) if texts and len(texts) == len(value.items) else None
    return None


def compiler(bench: Workbench) -> Callable[[str], Predicate]:
    """Return a function that compiles filter expressions to predicates on payloads.

    A fault sees only payloads: fields of frames and addresses have arbitrary values.
    """
    ends: dict[Link, Endpoint] = {link: _end(link, bench) for link in bench.columns.context.links}

    def compile_where(text: str) -> Predicate:
        where = Where(text, bench.columns.context)

        def passes(payload: bytes, link: Link) -> bool:
            datagram = Datagram(
                number=0,
                time_ns=0,
                link_type=LINKTYPE_RAW,
                frame=payload,
                payload=payload,
                payload_offset=0,
                original_length=len(payload),
                source=Endpoint("127.0.0.1", 0),
                destination=ends[link],
            )
            return bool(where.judge([bench.dissector.dissect(datagram)])[0])

        return passes

    return compile_where


def _end(link: Link, bench: Workbench) -> Endpoint:
    """Return a destination that is decoded as this link: if possible, a port that no other link claims."""
    context = bench.columns.context
    shared = np.flatnonzero(context.ports[link])
    alone = [port for port in shared if len(context.claimants[context.claim[port]]) == 1]
    ports = alone or shared
    return Endpoint("127.0.0.1", int(ports[0]) if len(ports) else 0)
