"""List all that is installed with this package as CycloneDX JSON: names, versions, licences, who needs whom.

Run: python .ci/make_sbom.py FILE. What the package asks for, with all extras and those for development, and
what that asks for in turn; versions and licences are read from what is installed in this environment.
"""

from __future__ import annotations

import json
import os
import re
import sys
import uuid
from datetime import datetime, timezone
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement

PACKAGE = "edoras-tools"
EXTRAS = ("all", "dev")
_SPDX = re.compile(r"[A-Za-z0-9.+-]+( (AND|OR|WITH) [A-Za-z0-9.+-]+)*")


def plain(name: str) -> str:
    """Return a name as package indexes compare it (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(of: Distribution, extras: tuple[str, ...]) -> list[Requirement]:
    """Return what a package asks for here, with some of its extras."""
    asked = [Requirement(text) for text in of.requires or ()]
    return [
        item
        for item in asked
        if item.marker is None or any(item.marker.evaluate({"extra": extra}) for extra in ("", *extras))
    ]


def installed(
    name: str = PACKAGE, extras: tuple[str, ...] = EXTRAS
) -> dict[str, tuple[Distribution, list[str]]]:
    """Return a package and all that it needs and that is there, each with what it needs itself."""
    found: dict[str, tuple[Distribution, list[str]]] = {}
    seen: set[tuple[str, str]] = set()
    wanted = [(name, ("", *extras))]
    while wanted:
        name, extras = wanted.pop()
        new = tuple(extra for extra in extras if (plain(name), extra) not in seen)
        seen |= {(plain(name), extra) for extra in new}
        try:
            there = distribution(name)
        except PackageNotFoundError:
            continue
        if not new:
            continue
        asked = requirements(there, new)
        _, needs = found.setdefault(plain(name), (there, []))
        needs += [plain(item.name) for item in asked]
        wanted += [(item.name, ("", *item.extras)) for item in asked]
    return {
        name: (there, sorted({item for item in needs if item in found} - {name}))
        for name, (there, needs) in sorted(found.items())
    }


def licence(of: Distribution) -> str:
    """Return a package's licence: its SPDX expression, else what its classifiers or it itself say."""
    metadata = of.metadata
    if expression := metadata.get("License-Expression"):
        return str(expression)
    classifiers = [item for item in metadata.get_all("Classifier") or () if item.startswith("License ::")]
    named = [item.rpartition(" :: ")[2] for item in classifiers if not item.endswith("OSI Approved")]
    return " OR ".join(named) or str(metadata.get("License") or "").partition("\n")[0].strip()


def component(name: str, of: Distribution) -> dict[str, Any]:
    """Return a package as a component."""
    said = licence(of)
    known = {"expression": said} if _SPDX.fullmatch(said) else {"license": {"name": said or "not said"}}
    return {
        "type": "library",
        "bom-ref": f"pkg:pypi/{name}@{of.version}",
        "name": of.metadata["Name"],
        "version": of.version,
        "licenses": [known],
        "purl": f"pkg:pypi/{name}@{of.version}",
    }


def bill() -> dict[str, Any]:
    """Return the bill of materials; the same environment gives the same, but for its time."""
    packages = installed()
    parts = {name: component(name, there) for name, (there, _) in packages.items()}
    own = {**parts.pop(PACKAGE), "type": "application"}
    references = {name: part["bom-ref"] for name, part in {**parts, PACKAGE: own}.items()}
    number = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps([own, parts], sort_keys=True))
    seconds = int(os.environ.get("SOURCE_DATE_EPOCH", datetime.now(timezone.utc).timestamp()))
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": number.urn,
        "version": 1,
        "metadata": {
            "timestamp": datetime.fromtimestamp(seconds, timezone.utc).isoformat().replace("+00:00", "Z"),
            "component": own,
        },
        "components": list(parts.values()),
        "dependencies": [
            {"ref": references[name], "dependsOn": [references[item] for item in needs]}
            for name, (_, needs) in packages.items()
        ],
    }


def main() -> None:
    """Write the bill to the file that is named."""
    path = Path(sys.argv[1])
    made = bill()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(made, indent=2) + "\n", encoding="utf-8")
    sys.stdout.write(f"{path}: {len(made['components'])} packages\n")


if __name__ == "__main__":
    main()
