"""What is installed with this package, by licence: a new one is looked at before it comes in.

The package itself is MIT. What it imports at all times, and what comes with an extra, may be used in any
program; the one exception has a name, and is imported only where somebody asks for it.
"""

from __future__ import annotations

import importlib.util
import json
import re

import pytest
from places import ROOT
from toml_files import TOML

GPL = {"scapy": "GPL-2.0-only"}
"""Imported by dissectors/ and by one back end of live capture, for systems without packet sockets."""
LICENCES = {
    "MIT": (
        "annotated-doc ast-serialize cfdp duckdb execnet fastcrc foxglove-sdk iniconfig librt linkify-it-py "
        "markdown-it-py mcap mdit-py-plugins mdurl mypy mypy-extensions platformdirs pluggy polars "
        "polars-runtime-32 pytest pytest-xdist rich rich-click ruamel-yaml ruff setuptools "
        "textual typer six backrefs charset-normalizer mergedeep mkdocs-get-deps mkdocs-material "
        "tomli exceptiongroup pytz "  # on Python 3.10
        "mkdocs-material-extensions paginate pymdown-extensions pyyaml pyyaml-env-tag urllib3 attrs cffi "
        "zipp aioitertools blinker flask-cors jmespath py-partiql-parser xmltodict"
    ),
    "MIT, in its file LICENSE": "resvg-py",
    "BSD": (
        "click colorama grimp import-linter lz4 msgspec numpy pandas pygments python-dateutil websockets "
        "zstandard babel idna jinja2 markdown markupsafe mkdocs cloudpickle dask distributed fsspec locket "
        "lxml partd psutil pycparser space-packet-parser tblib toolz zict "
        "flask itsdangerous s3fs werkzeug wrapt xxhash"
    ),
    "Apache-2.0": (
        "atheris deprecation ghp-import junitparser pyarrow requests rosbags sortedcontainers spacepackets "
        "types-pyyaml watchdog aiohttp aiosignal frozenlist importlib-metadata lazy-importer msgpack "
        "async-timeout tzdata "  # on Python 3.10
        "multidict propcache tornado yarl aiobotocore boto3 botocore moto responses s3transfer"
    ),
    "Apache-2.0 or BSD": "cryptography packaging",
    "Apache-2.0 and BSD": "prometheus-client",
    "EPL-2.0, or Apache-2.0, or BSD": "cyclonedds eclipse-zenoh",
    "MPL-2.0": "certifi hypothesis pathspec",
    "PSF-2.0": "aiohappyeyeballs backports-zstd isal typing-extensions",
    "ISC": "shellingham",
    "any that OSI approves": "apsw",
    "public domain": "pyelftools",
    **{licence: name for name, licence in GPL.items()},
}
SAYS = {
    "MIT": r"MIT(-0| License)?",
    "MIT, in its file LICENSE": r"",
    "BSD": r"(BSD|0BSD).*",
    "Apache-2.0": r"Apache.*",
    "Apache-2.0 or BSD": r"(?=.*Apache)(?=.*BSD).*",
    "Apache-2.0 and BSD": r"(?=.*Apache)(?=.* AND )(?=.*BSD).*",
    "EPL-2.0, or Apache-2.0, or BSD": r"(?=.*(EPL|Eclipse))(?=.*(Apache|BSD)).*",
    "MPL-2.0": r"(MPL|Mozilla).*",
    "PSF-2.0": r"(PSF|Python).*",
    "ISC": r"ISC.*",
    "any that OSI approves": r"any-OSI.*",
    "public domain": r"[Pp]ublic [Dd]omain",
    **{licence: licence for licence in GPL.values()},
}
"""What the packages write for each."""


@pytest.fixture(scope="module")
def sbom():
    spec = importlib.util.spec_from_file_location("make_sbom", ROOT / ".ci/make_sbom.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_each_is_listed_with_its_licence(sbom):
    listed = {name: licence for licence, names in LICENCES.items() for name in names.split()}
    there = {name: sbom.licence(item) for name, (item, _) in sbom.installed().items() if name != sbom.PACKAGE}
    assert set(there) <= set(listed), "look at its licence, and list it"
    wrong = {name: said for name, said in there.items() if not re.fullmatch(SAYS[listed[name]], said)}
    assert not wrong, "the licence is another one than is listed"
    gpl = {name for name, said in there.items() if re.search(r"\bA?GPL|General Public", said)}
    assert gpl <= set(GPL)


@pytest.mark.long
def test_the_bill_of_materials_is_whole(sbom, monkeypatch, tmp_path):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1")
    monkeypatch.setattr("sys.argv", ["make_sbom.py", str(tmp_path / "new/bill.json")])
    sbom.main()
    bill = json.loads((tmp_path / "new/bill.json").read_text())
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.6")
    assert bill["metadata"]["timestamp"] == "1970-01-01T00:00:01Z"
    assert bill == sbom.bill(), "the same environment gives the same bill"
    names = {item["name"].lower() for item in bill["components"]}
    wanted = TOML.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    assert {
        re.match(r"[\w.-]+", item)[0].lower() for item in wanted if "python_version <" not in item
    } <= names
    own = bill["metadata"]["component"]
    references = {own["bom-ref"], *(item["bom-ref"] for item in bill["components"])}
    assert len(references) == len(bill["components"]) + 1
    assert {item["ref"] for item in bill["dependencies"]} == references
    assert all(set(item["dependsOn"]) <= references for item in bill["dependencies"])
    assert all(item["purl"].startswith("pkg:pypi/") and item["licenses"] for item in bill["components"])


def test_every_locked_version_has_hashes_and_no_place_to_come_from(sbom):
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text
    assert "--index" not in text
    assert "/tmp" not in text
    entries = re.split(r"\n(?=[a-z])", text.partition("\n")[2])
    locked = {}
    for entry in entries:
        if found := re.match(r"([a-z][\w.-]*)==(\S+)", entry):
            assert re.search(r"--hash=sha256:[0-9a-f]{64}", entry), found[0]
            locked[found[1]] = found[2]
    project = TOML.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [item for extra in project["optional-dependencies"].values() for item in extra]
    asked = {re.match(r"[\w.-]+", item)[0] for item in (*project["dependencies"], *extras)}
    assert {sbom.plain(name) for name in asked} - {sbom.PACKAGE} <= set(locked)
