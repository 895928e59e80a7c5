"""What is installed as packages: every folder of ``edoras_tools``, and three folders that lie beside it."""

from setuptools import find_packages, setup

BESIDE = {
    "edoras_tools.dissectors": "dissectors",
    "edoras_tools.samples": "samples",
    "edoras_tools.schemas": "docs/schemas",
}

setup(packages=[*find_packages(include=["edoras_tools", "edoras_tools.*"]), *BESIDE], package_dir=BESIDE)
