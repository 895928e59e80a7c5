"""Build what is published: sdist and wheel, with links that work on a package index, and ``project.urls``.

Run: python .ci/make_dist.py REPOSITORY FOLDER, the first as https://host/owner/name. A package index shows
the README without the files beside it, so its relative links and pictures become addresses in the repository.
This is done to a copy of the tracked files; the wheel is built from the sdist, as an installer would.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
_REPOSITORY = re.compile(r"https://[\w.-]+(/[\w.-]+){2,}")
_LINK = re.compile(r"(!?)\[((?:[^][]|\[[^]]*\])*)\]\((?![a-z]+:|#)([^)#\s]+)(#[^)\s]*)?\)")
"""A relative link or picture: ``!`` or nothing, text, path, anchor."""
_BUILD = "import sys; from setuptools import build_meta; print(build_meta.build_{}(sys.argv[1]))"


def absolute_links(text: str, repository: str, folder: Path) -> str:
    """Return Markdown whose relative links are addresses in the repository; code blocks stay as they are.

    Raises:
        SystemExit: a link names a file that is not in ``folder``.
    """

    def address(link: re.Match[str]) -> str:
        picture, words, path, anchor = link.groups(default="")
        there = folder / path
        if not there.exists():
            sys.exit(f"README.md: {path} is not there")
        kind = "raw" if picture else "tree" if there.is_dir() else "blob"
        return f"{picture}[{words}]({repository}/{kind}/HEAD/{path}{anchor})"

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    parts[::2] = [_LINK.sub(address, part) for part in parts[::2]]
    return "".join(parts)


def addresses(repository: str) -> str:
    """Return the table ``project.urls``."""
    return f"""[project.urls]
Homepage = "{repository}"
Documentation = "{repository}/blob/HEAD/docs/README.md"
Changelog = "{repository}/blob/HEAD/CHANGELOG.md"
Issues = "{repository}/issues"

"""


def copy_tracked(source: Path, target: Path) -> None:
    """Copy the files that git knows."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=source, check=True, capture_output=True, text=True)  # noqa: S607
    for name in filter(None, listed.stdout.split("\0")):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / name, target / name)


def build(kind: str, source: Path, target: Path) -> Path:
    """Build an ``sdist`` or a ``wheel`` with the setuptools of this environment; return its path."""
    command = [sys.executable, "-c", _BUILD.format(kind), str(target)]
    done = subprocess.run(command, cwd=source, check=False, capture_output=True, text=True)  # noqa: S603
    if done.returncode:
        sys.exit(f"{kind}: {done.stderr}")
    return target / done.stdout.splitlines()[-1]


def main() -> None:
    """Build both into the folder that is named."""
    repository, folder = sys.argv[1].rstrip("/").removesuffix(".git"), Path(sys.argv[2]).absolute()
    if not _REPOSITORY.fullmatch(repository):
        sys.exit("name the repository: make dist REPOSITORY=https://host/owner/name")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        place = Path(temporary)
        copy_tracked(ROOT, place / "tree")
        readme, project = (place / "tree" / name for name in ("README.md", "pyproject.toml"))
        readme.write_text(absolute_links(readme.read_text(encoding="utf-8"), repository, place / "tree"))
        head, before, rest = project.read_text(encoding="utf-8").partition("[project.optional-dependencies]")
        project.write_text(head + addresses(repository) + before + rest, encoding="utf-8")
        sdist = build("sdist", place / "tree", folder)
        with tarfile.open(sdist) as packed:
            packed.extractall(place, filter="data")
        wheel = build("wheel", place / sdist.name.removesuffix(".tar.gz"), folder)
    sys.stdout.write(f"{sdist}\n{wheel}\n")


if __name__ == "__main__":
    main()
