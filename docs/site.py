"""The hooks of the site: pages outside of ``docs/`` join it, and the menu is the list in ``docs/README.md``.

Used by mkdocs, which ``make docs`` runs.
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Final

from mkdocs.structure.files import File

ROOT: Final = Path(__file__).resolve().parents[1]
OUTSIDE: Final = {
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "samples/README.md": "samples.md",
}
"""Pages outside of ``docs/``: their path in the repository, and their name in the site."""
_ROWS: Final = re.compile(r"^\| ([a-z ]+) \| \|$|\[([^\]]+)\]\(([\w./]+\.md)\)", re.MULTILINE)


def on_config(config: Any) -> Any:
    """Make the menu from the tables of the first page: a heading, then the pages that its rows name."""
    menu: list[Any] = [{"All pages": "README.md"}]
    told = {"README.md"}
    for heading, title, path in _ROWS.findall((ROOT / "docs/README.md").read_text(encoding="utf-8")):
        if heading:
            menu.append({heading.capitalize(): []})
        elif (name := _inside(path)) not in told and len(menu) > 1:
            told.add(name)
            next(iter(menu[-1].values())).append({title: name})
    config["nav"] = menu
    return config


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that stand outside of ``docs/``."""
    for path, name in OUTSIDE.items():
        files.append(File.generated(config, name, content=(ROOT / path).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Lead links to where the site has their targets; files of the repository are named instead of linked."""
    if page.file.src_uri == "changelog.md":
        page.meta["search"] = {"boost": 0.2}  # it has every word; the page of the thing comes first
    markdown = re.sub(
        r"^```(\w+) [^\n]*$", r"```\1", markdown, flags=re.MULTILINE
    )  # words for docs/refresh.py
    source = next((path for path, name in OUTSIDE.items() if name == page.file.src_uri), "")
    folder = (ROOT / source).parent if source else (ROOT / "docs" / page.file.src_uri).parent
    depth = page.file.src_uri.count("/")

    def led(found: re.Match[str]) -> str:
        text, target, heading = found[1], found[2], found[3] or ""
        path = (folder / target).resolve().relative_to(ROOT).as_posix()
        if path in OUTSIDE or path.startswith("docs/"):
            return f"[{text}]({'../' * depth}{OUTSIDE.get(path, path.removeprefix('docs/'))}{heading})"
        return f"{text} (`{path}`)"

    return re.sub(r"\[([^\]]+)\]\((?!https?:|#)([^)\s#]+)(#[^)\s]*)?\)", led, markdown)


def _inside(path: str) -> str:
    """Return the name in the site of a page that ``docs/README.md`` links."""
    return OUTSIDE.get(path.removeprefix("../"), path)
