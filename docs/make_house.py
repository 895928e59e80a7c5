"""Draws the folders of the package and which imports which, as they are: ``docs/house.svg``.

    python docs/make_house.py

A row a folder, in the order of pyproject.toml's import contract: importers stand above what they import. An
import that a way over other arrows stands for is left out.
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path
from typing import Final
from xml.sax.saxutils import escape

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGE: Final = "edoras_tools"
PICTURE: Final = ROOT / "docs/house.svg"
BOX: Final = 720
ROW: Final = 46
GAP: Final = 16
EDGE: Final = 16
LANE: Final = 14
"""Width of what one of the arrows at the right takes."""
STYLE: Final = """<style>
svg{background:#fff;font-family:sans-serif}
rect{fill:#eef3f8;stroke:#7c93ab}
path{fill:none;stroke:#4a6580;marker-end:url(#a)}
.name{font-weight:bold;font-size:14px}
.inside{font-size:11px;fill:#36516e}
.what{font-size:11px;fill:#333}
</style>
<defs><marker id="a" viewBox="0 0 8 8" refX="8" refY="4" markerWidth="7" markerHeight="7" orient="auto">
<path d="M0 0L8 4L0 8z" style="fill:#4a6580;stroke:none;marker-end:none"/></marker></defs>"""


def order() -> list[str]:
    """Return the folders, importers first, as the import contract lists them."""
    toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    settings = toml.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    rows = next(item["layers"] for item in contracts if item["type"] == "layers")
    return [name.strip(" ()").removeprefix(f"{PACKAGE}.") for row in rows for name in row.split("|")]


def imports() -> dict[str, set[str]]:
    """Return which folder imports which, from the syntax trees of all files."""
    found: dict[str, set[str]] = {}
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        owner = path.relative_to(ROOT / PACKAGE).with_suffix("").parts[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.ImportFrom) and node.module:
                names = [f"{node.module}.{alias.name}" for alias in node.names]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                package, *rest = name.split(".")
                if package == PACKAGE and rest and rest[0] != owner:
                    found.setdefault(owner, set()).add(rest[0])
    return found


def reduced(edges: dict[str, set[str]], known: set[str]) -> list[tuple[str, str]]:
    """Leave out every import that a longer way of other imports stands for."""
    edges = {name: edges.get(name, set()) & known for name in known}

    def below(name: str) -> set[str]:
        seen: set[str] = set()
        todo = list(edges[name])
        while todo:
            if (item := todo.pop()) not in seen:
                seen.add(item)
                todo += edges[item]
        return seen

    return sorted(
        (name, target)
        for name in known
        for target in edges[name]
        if not any(target in below(other) for other in edges[name] - {target})
    )


def contents(name: str) -> tuple[str, str]:
    """Return what a folder says that it is, and the folders inside it."""
    folder = ROOT / PACKAGE / name
    path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    first = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n")[0]
    inside = sorted(item.name for item in folder.glob("*") if (item / "__init__.py").exists())
    return first.replace("``", ""), "  ".join(inside)


def picture() -> str:
    """Return the drawing as SVG."""
    names = order()
    top = {name: EDGE + index * (ROW + GAP) for index, name in enumerate(names)}
    drawn: list[str] = []
    for name in names:
        what, inside = contents(name)
        drawn += [
            f'<rect x="{EDGE}" y="{top[name]}" width="{BOX}" height="{ROW}" rx="6"/>',
            f'<text class="name" x="{EDGE + 12}" y="{top[name] + 18}">{escape(name)}</text>',
            f'<text class="inside" x="{EDGE + 110}" y="{top[name] + 18}">{escape(inside)}</text>',
            f'<text class="what" x="{EDGE + 12}" y="{top[name] + 36}">{escape(what)}</text>',
        ]
    lanes: list[list[tuple[int, int]]] = []
    for name, target in sorted(reduced(imports(), set(names)), key=lambda edge: top[edge[1]] - top[edge[0]]):
        start, end = top[name] + ROW, top[target]
        if end - start == GAP:
            drawn.append(f'<path d="M{EDGE + BOX // 2} {start} V{end}"/>')
            continue
        free = (lane for lane in lanes if all(low >= end or high <= start for low, high in lane))
        lane = next(free, None)
        if lane is None:
            lanes.append(lane := [])
        lane.append((start, end))
        right, at = EDGE + BOX, EDGE + BOX + LANE * (lanes.index(lane) + 1)
        drawn.append(f'<path d="M{right} {start - 12} H{at - 6} q6 0 6 6 V{end + 6} q0 6 -6 6 H{right}"/>')
    width, height = 2 * EDGE + BOX + LANE * (len(lanes) + 1), 2 * EDGE + len(names) * (ROW + GAP) - GAP
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}">'
    return "\n".join([head, STYLE, *drawn, "</svg>\n"])


if __name__ == "__main__":
    PICTURE.write_text(picture(), encoding="utf-8")
