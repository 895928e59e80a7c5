"""``edoras echo``, ``bw``, ``delay``, ``topic``, and ``hz`` of a graph: like the verbs of ``ros2 topic``.

Their input is a graph, unless a file or live traffic is named.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from msgspec.structs import replace
from typer import Argument, BadParameter, Option

from edoras_tools.addons.ros_verbs.echo import TextOptions
from edoras_tools.cli import options
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.inputs import FileOptions, InputOptions, LiveOptions, open_input
from edoras_tools.cli.main import command_group
from edoras_tools.cli.output import print_json, tell
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.io.formats.table import READ_PACKED

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edoras_tools.addons.ros_verbs.endpoints import GraphEndpoint
    from edoras_tools.addons.ros_verbs.messages import Kind, MessageBlock
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


_READ = f"{READ_PACKED}; without one, the ROS 2 graph."
Arguments = Annotated[list[str] | None, Argument(metavar="[FILE]... TOPIC", help=_READ)]
Listing = Annotated[list[str] | None, Argument(metavar="[FILE]...", help=_READ)]
Verbose = Annotated[bool, Option("--verbose", "-v", help="Publishers and subscriptions, too.")]
_EVERY_NS = 1_000_000_000


@grouped
def echo(
    *,
    arguments: Arguments = None,
    source: SourceOptions,
    qos: QosOptions,
    texts: TextOptions,
    where: Annotated[str | None, Option(parser=options.where, help="Only what passes this filter.")] = None,
    once: Annotated[bool, Option("--once", help="Print one message and end.")] = False,
    no_lost_messages: Annotated[bool, Option("--no-lost-messages", help="Do not tell of losses.")] = False,
    decoding: options.DecodingOptions,
) -> None:
    """Print the messages of a topic.

    Of a graph, a link, a capture or a recording, as ros2 topic echo does.
    """
    from edoras_tools.addons.ros_verbs.messages import read_topics

    words, before = Words.of(arguments), 0
    topic = words.topic("echo")
    opened, bench = source.open(words, decoding, qos)
    for blocks in read_topics(opened, bench, (topic,), where or "", source.duration or 0):
        lost = getattr(opened, "lost", {}).get(topic, 0)
        if lost > before and not no_lost_messages:
            change, before = lost - before, lost
            sys.stdout.write(
                f"A message was lost!!!\n\ttotal count change:{change}\n\ttotal count: {lost}---\n"
            )
        for block in blocks:
            for index in range(1 if once else len(block.time_ns)):
                sys.stdout.write(_message(block, index, texts, bench))
        sys.stdout.flush()
        if once and blocks:
            return


def _message(block: MessageBlock, index: int, texts: TextOptions, bench: Workbench) -> str:
    """Return one message as text, with its separator from the next one."""
    cdr, before, end = block.cdr(index), "", "" if texts.csv else "---\n"
    if texts.message_info:
        info: dict[str, int | None] = {
            "source_timestamp": int(block.published_ns[index]),
            "received_timestamp": int(block.time_ns[index]),
            "publication_sequence_number": int(block.sequence[index]) or None,
            "reception_sequence_number": None,
        }
        values = {name: "null" if value is None else value for name, value in sorted(info.items())}
        before = "".join(f"{name}: {value}\n" for name, value in values.items()) + end
        before = ",".join(map(str, info.values())) + "," if texts.csv else before
    try:
        text = f"{cdr!r}\n" if texts.raw else texts.text(bench.types, block.type, cdr)
    except WireError as error:
        text = f"{block.topic}: not a valid {block.type}: {error}\n"
    return f"{before}{text}{end}"


class MeasureOptions(NamedTuple):
    """The measured messages, and the form of the figures."""

    source: SourceOptions = SourceOptions()
    window: Annotated[int | None, Option("--window", "-w", parser=options.count, help="Messages.")] = None
    json: options.Json = False
    decoding: options.DecodingOptions = options.DecodingOptions()


def _measure(kind: Kind, arguments: Sequence[str] | None, how: MeasureOptions) -> None:
    """Measure topics; print the figures once a second and at the end, or once at the end as JSON."""
    from edoras_tools.addons.ros_verbs.messages import USUAL_WINDOWS, TopicFigures, rate_table, read_topics

    words, (source, window, json, decoding) = Words.of(arguments), how
    if kind != "hz" or not words.topics:
        words.topic(kind)
    figures = {topic: TopicFigures(kind, topic, window or USUAL_WINDOWS[kind]) for topic in words.topics}
    opened, bench = source.open(words, decoding)
    due = monotonic_ns() + _EVERY_NS

    def show() -> None:
        first, *others = figures.values()
        text = rate_table([first, *others]).rstrip("\n") if others else first.text()
        sys.stdout.write(f"{text}\n" if text else "")
        sys.stdout.flush()

    for blocks in read_topics(opened, bench, words.topics, duration_ns=source.duration or 0):
        for block in blocks:
            figures[block.topic].add(block, bench.types)
        if opened.live and not json and monotonic_ns() >= due:
            due += _EVERY_NS
            show()
    if json:
        print_json({"source": opened.info.name, "topics": [item.as_json() for item in figures.values()]})
    elif not opened.live:
        show()


@grouped
def bw(*, arguments: Arguments = None, how: MeasureOptions) -> None:
    """Show the bytes a second of a topic.

    Of a graph, a link, a capture or a recording, as ros2 topic bw does.
    """
    _measure("bw", arguments, how)


@grouped
def delay(*, arguments: Arguments = None, how: MeasureOptions) -> None:
    """Show how old messages are.

    By their headers. Of a graph, a link, a capture or a recording, as ros2 topic delay does.
    """
    _measure("delay", arguments, how)


def graph_hz(
    arguments: Sequence[str],
    graph: RosOptions,
    duration: int | None,
    window: int | None,
    decoding: options.DecodingOptions,
    *,
    json: bool,
) -> None:
    """Show the rates of topics of a graph or a recording, for ``edoras hz``."""
    source = SourceOptions(duration=duration, graph=graph)
    _measure("hz", arguments, MeasureOptions(source, window, json, decoding))


topic = command_group("topic", "List topics, or say more of one.")


@topic.command("list")
@grouped
def list_topics(
    *,
    arguments: Listing = None,
    source: SourceOptions,
    show_types: Annotated[bool, Option("--show-types", "-t", help="Their types, too.")] = False,
    count_topics: Annotated[bool, Option("--count-topics", help="Only how many there are.")] = False,
    hidden: Annotated[bool, Option("--include-hidden-topics", help="Also /_topics.")] = False,
    verbose: Verbose = False,
    json: options.Json = False,
    decoding: options.DecodingOptions,
) -> None:
    """List topics, as ros2 topic list does."""
    words = Words.of(arguments)
    topics = [item for item in _topics(words, source, decoding) if hidden or "/_" not in item["topic"]]
    if json:
        _print_topics(words, topics)
    elif count_topics:
        sys.stdout.write(f"{len(topics)}\n")
    elif not verbose:
        lines = (f"{item['topic']} [{item['type']}]" if show_types else item["topic"] for item in topics)
        sys.stdout.write("".join(f"{line}\n" for line in lines))
    for name in ("publishers", "subscriptions") if verbose and not json else ():
        noun = {"publishers": ("Published", "publisher"), "subscriptions": ("Subscribed", "subscriber")}[name]
        sys.stdout.write(f"{noun[0]} topics:\n")
        for item in topics:
            if many := item[name]:
                plural = "s" if many > 1 else ""
                sys.stdout.write(f" * {item['topic']} [{item['type']}] {many} {noun[1]}{plural}\n")
        sys.stdout.write("\n")


@topic.command("info")
@grouped
def info(
    *,
    arguments: Arguments = None,
    source: SourceOptions,
    verbose: Verbose = False,
    json: options.Json = False,
    decoding: options.DecodingOptions,
) -> None:
    """Show type, publishers and subscriptions of a topic, as ros2 topic info does."""
    words = Words.of(arguments)
    name = words.topic("topic info")
    entry = next((item for item in _topics(words, source, decoding) if item["topic"] == name), None)
    if entry is None:
        raise ConfigError(f"unknown topic {name!r}; edoras topic list shows all")
    if json:
        _print_topics(words, [entry])
        return
    end = "\n\n" if verbose else "\n"
    sys.stdout.write(f"Type: {entry['type']}{end}")
    for noun, key in (("Publisher", "publishers"), ("Subscription", "subscriptions")):
        sys.stdout.write(f"{noun} count: {'unknown' if entry[key] is None else entry[key]}{end}")
        for text in entry["details"][key] if verbose else ():
            sys.stdout.write(f"{text}{end}")


def _print_topics(words: Words, topics: Sequence[dict[str, Any]]) -> None:
    rows = [{name: value for name, value in item.items() if name != "details"} for item in topics]
    print_json({"source": ", ".join(map(str, words.files)) or None, "topics": rows})


def _topics(words: Words, source: SourceOptions, decoding: options.DecodingOptions) -> list[dict[str, Any]]:
    """Return the topics of the input, with the known facts on publishers and subscriptions."""
    from edoras_tools.addons.ros_verbs.endpoints import policies_text, recorded_policies
    from edoras_tools.addons.ros_verbs.source import topics_of_graph

    if source.reads_graph(words):
        return topics_of_graph(source.request(()), decoding.settings())
    from edoras_tools.addons.ros_verbs.messages import topics_in

    rows = []
    for item, profiles, is_published in topics_in(*source.open(words, decoding), source.duration or 0):
        texts = [policies_text(offer) for offer in recorded_policies(profiles)]
        details = {"publishers": [f"Endpoint type: PUBLISHER\n{text}" for text in texts], "subscriptions": ()}
        counts = {"publishers": len(texts) or (1 if is_published else None), "subscriptions": None}
        rows.append({"topic": item.name, "type": item.type, **counts, "details": details})
    return rows
