"""Writes what the sample captures decode to: ``expected/*.json``.

    python samples/make_expected.py

A change in there is a change of what users get: read the difference before you commit it. ``tests/samples``
compares today's decode with these files, and judges them by code that shares nothing with the decoders.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Final

from edoras_tools.io.formats.open import open_file
from edoras_tools.pipelines.capture.ledger import Ledger
from edoras_tools.pipelines.capture.packet_json import as_json
from edoras_tools.pipelines.capture.record import CaptureReport
from edoras_tools.pipelines.workbench import Settings
from edoras_tools.render.severity import NOTABLE

SAMPLES: Final = Path(__file__).resolve().parent
MISSIONS: Final = {
    "a_rover": ("rover_ground",),
    "b_arm_single": ("single_arm_ground",),
    "e_ci_errors": ("rover_ground",),
    "f_sbn_disconnect": ("two_rovers_ground", "two_rovers_flight"),
}
"""The captures, each with the mission files of its demo."""


def expected(capture: str) -> dict[str, Any]:
    """Decode a capture.

    Returns:
        ``info``: what ``edoras info --json`` says. ``packets``: what ``edoras sniff --json`` says of the
        first packet of each kind, where a link, an SBN type, a MsgId and a set of findings make a kind.
        ``notable``: number and findings of every packet that has a warning or an error.
    """
    bench = Settings([SAMPLES / f"missions/{name}.yaml" for name in MISSIONS[capture]]).workbench()
    source = open_file(SAMPLES / f"captures/{capture}.pcap")
    report = CaptureReport(Ledger(bench.mission), source)
    kinds: dict[tuple[Any, ...], dict[str, Any]] = {}
    notable: dict[str, list[str]] = {}
    for batch in source.batches():
        report.ledger.add(batch, bench.columns.decode(batch))
        for row in range(len(batch)):
            decoded = bench.dissector.dissect(batch[row])
            network = decoded.layer("sbn")
            packet = as_json(decoded)
            kind = (
                decoded.link,
                network.values()["msg_type"] if network else None,
                packet["msg_id"],
                decoded.findings,
            )
            kinds.setdefault(kind, packet)
            if decoded.findings & NOTABLE:
                notable[str(packet["number"])] = packet["findings"]
    source.close()
    return {
        "capture": f"captures/{capture}.pcap",
        "missions": [f"missions/{name}.yaml" for name in MISSIONS[capture]],
        "info": {**report.summary(), "source": f"{capture}.pcap"},
        "packets": list(kinds.values()),
        "notable": notable,
    }


def text(value: dict[str, Any]) -> str:
    """Return an expected decode as JSON, a route, a packet and a notable packet a line."""
    info = {**value["info"], "routes": _lines(value["info"]["routes"], 6)}
    parts = {
        **{name: json.dumps(value[name]) for name in ("capture", "missions")},
        "info": "{\n" + ",\n".join(f'    "{name}": {_shown(item)}' for name, item in info.items()) + "\n  }",
        "packets": _lines(value["packets"], 4),
        "notable": "{\n"
        + ",\n".join(f'    "{number}": {json.dumps(item)}' for number, item in value["notable"].items())
        + "\n  }",
    }
    return "{\n" + ",\n".join(f'  "{name}": {item}' for name, item in parts.items()) + "\n}\n"


def _shown(item: Any) -> str:
    return item if isinstance(item, str) and item.startswith("[\n") else json.dumps(item, ensure_ascii=False)


def _lines(items: list[Any], indent: int) -> str:
    space = " " * indent
    rows = ",\n".join(space + json.dumps(item, ensure_ascii=False) for item in items)
    return f"[\n{rows}\n{space[2:]}]"


def main() -> None:
    """Write them all."""
    for capture in MISSIONS:
        path = SAMPLES / f"expected/{capture}.json"
        path.write_text(text(expected(capture)), encoding="utf-8")


if __name__ == "__main__":
    main()
