"""What is wrong before a network is needed."""

import sys

import pytest

from edoras_tools.addons.dds.graph import open_graph
from edoras_tools.errors import ConfigError
from edoras_tools.middleware import graph
from edoras_tools.ros import TypeStore


def test_without_the_library_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds.internal", None)
    for name in ("graph", "endpoints"):  # as in a process that has not joined a graph yet
        monkeypatch.delitem(sys.modules, f"edoras_tools.addons.dds.{name}", raising=False)
        monkeypatch.delattr(f"edoras_tools.addons.dds.{name}", raising=False)
    with pytest.raises(ConfigError, match=r"--ros dds needs an extra .*: pip install 'edoras-tools\[dds\]'"):
        graph.open_graph("dds", TypeStore(), "bridge")


@pytest.mark.parametrize("name", ["", "9lives", "a b", "/", "a//b"])
def test_a_node_has_a_ros_name(name):
    with pytest.raises(ConfigError, match="is not a ROS name"):
        open_graph(TypeStore(), name)


def test_an_option_that_does_not_exist_is_refused():
    with pytest.raises(ConfigError, match="--ros dds has no option 'router'"):
        open_graph(TypeStore(), "bridge", options={"router": "tcp/localhost:7447"})


@pytest.mark.own_network
@pytest.mark.parametrize(("distro", "told"), [("humble", "humble"), ("jazzy", "jazzy"), ("kilted", "jazzy")])
def test_the_distribution_is_that_of_the_nodes_there(distro, told):
    peer = open_graph(TypeStore(distro), "peer", domain=71)
    try:
        assert graph.distro_of_peers("dds", 71) == told
    finally:
        peer.close()


@pytest.mark.own_network
def test_where_nobody_is_nobody_tells_the_distribution():
    assert graph.distro_of_peers("dds", 72) is None
    assert graph.distro_of_peers("local", 72) is None
    assert graph.distro_of_peers("dds", 72, {"multicast": "odd"}) is None
