"""The middleware by name."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from edoras_tools.addons.lab.demo.local_graph import LocalGraph
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import open_graph
from edoras_tools.middleware.graph import middleware, usual, usual_domain
from edoras_tools.ros import TypeStore


def test_a_graph_by_name():
    graph = open_graph("local", TypeStore(), "node", domain=9)
    graph.close()
    assert isinstance(graph, LocalGraph)


@pytest.mark.parametrize(
    ("ros", "told"),
    [
        ("zenoh", "--ros zenoh needs an extra (no such library): pip install 'edoras-tools[zenoh]'"),
        ("foxglove", "--ros foxglove needs an extra (no such library): pip install 'edoras-tools[live]'"),
        (
            "rclpy",
            (
                "--ros rclpy needs a ROS 2 of Python 3.VERSION (no such library); source its setup.bash, or: "
                "pip install ros-rclpy ros-rmw-fastrtps-cpp"
            ),
        ),
    ],
)
def test_an_absent_library_is_one_line_that_says_what_to_install(monkeypatch, ros, told):
    def absent(*_arguments, **_options):
        raise ImportError("no such library\nand how to get it")

    module = middleware(ros).place.partition(":")[0]
    monkeypatch.setitem(sys.modules, module, SimpleNamespace(open_graph=absent))
    with pytest.raises(ConfigError) as caught:
        open_graph(ros, TypeStore(), "node")
    assert str(caught.value) == told.replace("VERSION", str(sys.version_info.minor))


def test_a_library_that_does_not_load_is_one_line(monkeypatch):
    def broken(_name):
        raise OSError("libddsc.so: wrong ELF class")

    monkeypatch.setattr("edoras_tools.doors.imported", broken)
    with pytest.raises(ConfigError, match=r"^--ros rclpy: its library does not load: libddsc.so: wrong ELF"):
        open_graph("rclpy", TypeStore(), "node")


def test_another_name_is_told():
    with pytest.raises(
        ConfigError, match=r"'ddz' is not known; there are dds, foxglove, local, rclpy, zenoh"
    ):
        open_graph("ddz", TypeStore(), "node")


def test_the_environment_says_what_is_usual():
    assert [usual({"RMW_IMPLEMENTATION": name}) for name in ("rmw_zenoh_cpp", "rmw_fastrtps_cpp", "")] == [
        "zenoh",
        "dds",
        "dds",
    ]
    assert [usual_domain({}), usual_domain({"ROS_DOMAIN_ID": "42"})] == [0, 42]
    for text in ("x", "-1", "233"):
        with pytest.raises(ConfigError, match="is not a domain"):
            usual_domain({"ROS_DOMAIN_ID": text})
