"""The input of the commands: a graph, unless a file or live traffic is named."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

from msgspec.structs import replace
from typer import BadParameter, Option

from edoras_tools.cli import options
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.endings import tell
from edoras_tools.cli.inputs import FileOptions, InputOptions, LiveOptions, open_input
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.ros_verbs.endpoints import GraphEndpoint
    from edoras_tools.addons.ros_verbs.source import GraphRequest
    from edoras_tools.io import Source
    from edoras_tools.middleware.graph import Qos
    from edoras_tools.pipelines.workbench import Workbench


class Words(NamedTuple):
    """Arguments without an option: files, then topics."""

    files: list[Path]
    topics: list[str]

    @classmethod
    def of(cls, arguments: Sequence[str] | None) -> Words:
        """Return the files and topics among arguments: a topic begins with a slash and is no file."""
        words = list(arguments or ())
        topics = [word for word in words if word.startswith("/") and not Path(word).exists()]
        return cls([Path(word) for word in words if word not in topics], topics)

    def topic(self, command: str) -> str:
        """Return the single topic.

        Raises:
            ConfigError: there is none, or more than one.
        """
        if len(self.topics) != 1:
            raise ConfigError(f"name one topic: edoras {command} [FILE]... /cmd_vel")
        return self.topics[0]


class QosOptions(NamedTuple):
    """Quality of service of the subscription; by default the publishers' offer."""

    reliability: Annotated[str | None, Option("--qos-reliability", help="reliable, best_effort.")] = None
    durability: Annotated[str | None, Option("--qos-durability", help="volatile, transient_local.")] = None
    depth: Annotated[int | None, Option("--qos-depth", parser=options.count, help="Messages kept.")] = None

    def fitting(self, publishers: Sequence[GraphEndpoint]) -> Qos:
        """Return the quality of service of a subscription to some publishers."""
        from edoras_tools.addons.ros_verbs.endpoints import fitting_qos

        qos = fitting_qos(publishers)
        reliable = {"reliable": True, "best_effort": False, None: qos.reliable}
        lasting = {"transient_local": True, "volatile": False, None: qos.transient_local}
        for value, choices in ((self.reliability, reliable), (self.durability, lasting)):
            if value not in choices:
                raise BadParameter(f"{value!r} is not one of {', '.join(filter(None, choices))}")
        kinds = {"reliable": reliable[self.reliability], "transient_local": lasting[self.durability]}
        return replace(qos, **kinds, depth=self.depth or qos.depth)


class SourceOptions(NamedTuple):
    """The source of messages if no file is named."""

    interface: Annotated[
        str | None, Option("--interface", "-i", metavar="IFACE", help="A link: capture here.")
    ] = None
    listen: Annotated[list[str] | None, Option(hidden=True)] = None
    duration: options.Duration = None
    graph: RosOptions = RosOptions()

    def request(self, topics: Sequence[str], qos: QosOptions = QosOptions()) -> GraphRequest:
        """Return the request for a graph."""
        from edoras_tools.addons.ros_verbs.source import GraphRequest
        from edoras_tools.middleware.opening import usual, usual_domain

        ros, domain, more = self.graph
        domain = usual_domain() if domain is None else domain
        return GraphRequest(ros or usual(), domain, dict(more or ()), topics, qos.fitting, tell)

    def reads_graph(self, words: Words) -> bool:
        """Return whether the input is a graph.

        Raises:
            ConfigError: a graph and another input are named.
        """
        options.check_duration(self.duration, words.files)
        others = bool(words.files or self.interface or self.listen)
        if others and any(self.graph):
            raise ConfigError("name one input: FILE..., -i IFACE, or --ros for a graph")
        return not others

    def open(
        self, words: Words, decoding: options.DecodingOptions, qos: QosOptions = QosOptions()
    ) -> tuple[Source, Workbench]:
        """Open the single input.

        Raises:
            ConfigError: more than one is named, or it cannot be opened.
            CaptureError: it cannot be opened.
        """
        if not self.reads_graph(words):
            inputs = InputOptions(FileOptions(words.files), LiveOptions(self.interface, self.listen))
            return open_input(inputs, decoding.settings(), messages=True)
        from edoras_tools.addons.ros_verbs.source import open_source

        return open_source(self.request(words.topics, qos), decoding.settings())
