"""What was lost in each real capture, and how a diagnosis of it is judged by that: the public result alone.

``python tests/support/truth.py [--json-dir DIR] [NAME ...]`` prints the score of every capture.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from edoras_tools.decode import Options
from edoras_tools.io.formats.open import open_file
from edoras_tools.links import table
from edoras_tools.pipelines.doctor import examine
from edoras_tools.pipelines.workbench import Settings

if TYPE_CHECKING:
    from edoras_tools.diagnosis.examination import Diagnosis

FOLDER = Path(__file__).parents[1] / "captures"
REST = ("lost", "unaccounted", "uncertain", "shared", "superseded", "waiting", "not_captured")
BLAME = ("did not pass them on", "nothing in the capture says why")


@dataclass(frozen=True)
class Truth:
    """What is true of a capture.

    Attributes:
        lost: arrivals lost.
        by: the same by MsgId of the row, where the sources tell.
        source: where the figures stand: ``marks``, ``README`` of the captures where the marks do not
            say it, ``tests`` where only older tests of this project do.
        options: of ``edoras doctor``.
        causes: names in ``lost_by`` that must be there.
        not_said: sentences that must not occur.
        wide: a range may be wider: the capture ends in an overload, or has a hole.
    """

    lost: int
    by: dict[str, int] = field(default_factory=dict)
    source: str = "marks"
    options: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    not_said: tuple[str, ...] = BLAME
    wide: bool = False


CI_5234 = ("--port", "ci:5234")
TRUTHS = {
    "a_rover": Truth(92, {"0x1827": 92}, "README", causes=("limit",)),
    "b_arm_single": Truth(0, source="README"),
    "c1_tlm_rate_limit4": Truth(16_706, {"0x0827": 16_706}, causes=("limit",)),
    "c3_mqueue10": Truth(178, causes=("limit", "overflow"), not_said=(*BLAME, "TO's pipe of 50")),
    "c4_cmd_rate": Truth(1_793, {"0x1827": 1_793}, causes=("limit", "socket")),
    "d3_cpu1_cpu2": Truth(6_601, source="tests"),
    "n1_to_remove_all": Truth(0),
    "n3_cfs_restart": Truth(38, {"0x1827": 38}, causes=("down",)),
    "n5_app_restarts": Truth(158, {"0x1827": 136}, "tests", causes=("restart", "stopped")),
    "n10_uplink_loss": Truth(34, {"0x1827": 34}, options=CI_5234, causes=("network",)),
    "n12_two_hosts_flight": Truth(83, source="README", causes=("after",)),
    "n12_two_hosts_ground": Truth(83, source="README", causes=("after",)),
    "p6b_extended_header": Truth(23, {"0x1827": 23}, causes=("limit",)),
    "season3/q01_two_causes_one_counter": Truth(258, {"0x1827": 29, "0x0827": 229}, causes=("limit",)),
    "season3/q04b_bridge_restarts_subscribes_one": Truth(
        67, source="README", causes=("sbn_timeout", "sbn_peer_restart", "unsubscribed", "away")
    ),
    "season3/q07_uplink_dup_loss_reorder_ground": Truth(
        37, source="README", options=CI_5234, causes=("limit",)
    ),
    "season3/q08b_later_fragments_dropped": Truth(
        80, {"0x0800": 19, "0x0801": 19, "0x0804": 19, "0x0827": 19, "0x0808": 4}, "README"
    ),
    "season3/q12_to_limits_changed": Truth(254, {"0x0827": 254}, causes=("limit",)),
    "season3/q17_two_bridges_same_topic": Truth(41, {"0x1827": 41}, "README", causes=("limit",)),
    "season3/q21_app_restart_while_overloaded": Truth(181, {"0x1827": 181}, causes=("limit",)),
    "season3/q22_to_enabled_late_loss_at_the_end": Truth(87, {"0x1827": 87}, causes=("limit",), wide=True),
    "season3/q25_robot_off_then_bridge_off": Truth(139, {"0x1827": 64}, causes=("limit", "port_closed")),
    "season3/q27_three_hops_one_counter": Truth(427, causes=("limit",)),
    "season3/e2_ci_nosubs": Truth(32, {"0x1827": 22, "0x18ee": 10}, causes=("limit", "no_subscriber")),
    "season3/n8_time_jumps": Truth(0),
    "season3/n11_jointstate_sizes": Truth(44, source="README"),
    "season3/p4_apps_stopped": Truth(120, causes=("stopped",)),
}


def judge(result: dict, truth: Truth) -> list[str]:
    """Return what is wrong with ``doctor --json``, of schema 1 or 2; names that are missing count as 0."""
    text = json.dumps(result, ensure_ascii=False)
    return [
        *sums(result),
        *_range("whole", result, truth.lost, truth.wide),
        *_rows(result, truth),
        *(f"cause not named: {cause}" for cause in truth.causes if not causes(result)[cause]),
        *(f"said: {sentence}" for sentence in truth.not_said if sentence in text),
    ]


def causes(result: dict) -> Counter[str]:
    """Return how many are lost by each cause."""
    found: Counter[str] = Counter()
    for row in result["balance"]:
        found.update(row["lost_by"])
    return found


def bounds(part: dict) -> tuple[int, int]:
    """Return the lost of a row or the whole that are proven, and how many more may be."""
    proven = _figure(part, "lost") + _figure(part, "unaccounted")
    return proven, _figure(part, "uncertain") + _figure(part, "shared")


def _figure(part: dict, name: str) -> int:
    return part.get(name) or 0


def _range(name: str, part: dict, true: int, wide: bool) -> list[str]:
    proven, more = bounds(part)
    faults = [] if proven <= true <= proven + more else [f"{name}: {proven} to {proven + more}, truth {true}"]
    if more > max(6, true / 10) and not wide:
        faults.append(f"{name}: the range is {more} wide")
    return faults


def _rows(result: dict, truth: Truth) -> list[str]:
    faults = []
    for msg_id, true in truth.by.items():
        parts = [bounds(row) for row in result["balance"] if row["msg_id"] == msg_id]
        low, more = (sum(column) for column in zip(*parts, strict=True)) if parts else (0, 0)
        if not low <= true <= low + more:
            faults.append(f"{msg_id}: {low} to {low + more}, truth {true}")
    return faults


def sums(result: dict) -> list[str]:
    """Return the sums that are wrong, of rows and of the whole, and what is negative."""
    faults = []
    for row in result["balance"]:
        name = f"row {row['msg_id']} {row['hop']}"
        if min(_figure(row, item) for item in ("in", "out", "duplicated", *REST)) < 0:
            faults.append(f"{name}: negative")
        if row["lost"] is None:
            continue
        came, left = row["in"] + row["duplicated"], row["out"] + sum(_figure(row, item) for item in REST)
        if came != left:
            faults.append(f"{name}: {came} in, {left} accounted for")
    for item in ("lost", "unaccounted", "superseded"):
        total = sum(_figure(row, item) for row in result["balance"])
        if _figure(result, item) != total:
            faults.append(f"{item}: whole {_figure(result, item)}, rows {total}")
    return faults


def diagnosed(path: Path, options: tuple[str, ...] = (), configs: tuple[Path, ...] = ()) -> dict:
    """Return what ``edoras doctor --json`` says of a capture.

    Args:
        path: of the capture.
        options: pairs of ``--port`` and ``LINK:PORT``.
        configs: files of a mission.
    """
    made = examined if path.is_relative_to(FOLDER) and not configs else examined.__wrapped__
    return made(path, options, configs).as_json()


@cache
def examined(path: Path, options: tuple[str, ...] = (), configs: tuple[Path, ...] = ()) -> Diagnosis:
    """Return the diagnosis of a capture as it is; all tests of a worker share it, and none changes it."""
    ports = [word.split(":") for word in options[1::2]]
    links = Options(ports=tuple((table.link_of_label(link), int(port)) for link, port in ports))
    with closing(open_file(path)) as source:
        bench = Settings(configs=list(configs), options=links).workbench(source.info, [path])
        return examine(source, bench).diagnosis


def diagnosis(name: str) -> dict:
    """Return what is said of a capture of the table."""
    return diagnosed(FOLDER / f"{name}.pcap.zst", TRUTHS[name].options)


def main() -> None:
    """Print the score of the captures."""
    parser = argparse.ArgumentParser(description="Judge the doctor by what was counted.")
    parser.add_argument("--json-dir", type=Path, help="write what the doctor says here")
    parser.add_argument("names", nargs="*", default=list(TRUTHS), metavar="NAME")
    options = parser.parse_args()
    with ProcessPoolExecutor(2) as pool:
        results = dict(zip(options.names, pool.map(diagnosis, options.names), strict=True))
    right = 0
    print(f"{'capture':48}{'truth':>7}{'proven':>8}{'more':>6}  causes; faults")
    for name, result in results.items():
        if options.json_dir:
            options.json_dir.mkdir(parents=True, exist_ok=True)
            (options.json_dir / f"{Path(name).name}.json").write_text(json.dumps(result))
        faults = judge(result, TRUTHS[name])
        right += not faults
        proven, more = bounds(result)
        by = " ".join(f"{cause} {number}" for cause, number in causes(result).items() if number)
        print(f"{name:48}{TRUTHS[name].lost:>7,}{proven:>8,}{more:>6,}  {by or '-'}")
        for fault in faults:
            print(f"{'':8}{fault}")
    print(f"{right} of {len(results)} without a fault")


if __name__ == "__main__":
    main()
