"""``edoras echo``, ``bw``, ``delay``, ``topic``, and ``hz`` of a graph; ``edoras observe`` and ``play``.

The verbs of ``ros2 topic`` have a graph as their input, unless a file or live traffic is named. ``observe``
counts what publishers and subscriptions of a graph exchange; ``play`` publishes a recording in one.

``echo`` prints messages as ``ros2 topic echo`` does: YAML or CSV, long values cut. A float32 number is
printed with the digits of the equal double, as rclpy prints it.
"""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

from msgspec.structs import asdict, replace
from typer import Argument, BadParameter, Exit, Option

from edoras_tools.cli import options, recordings
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.inputs import FileOptions, InputOptions, LiveOptions, open_input
from edoras_tools.cli.main import command_group
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import INTERRUPTED, end, finish, print_json, say, tell
from edoras_tools.cli.replay import pair
from edoras_tools.cli.sending import factor, loops
from edoras_tools.errors import ConfigError, WireError
from edoras_tools.io.formats.table import READ_PACKED
from edoras_tools.ros.library import MessageField, Shape

if TYPE_CHECKING:
    from edoras_tools.addons.ros_verbs.endpoints import GraphEndpoint, GraphRequest
    from edoras_tools.addons.ros_verbs.playing import Kind, MessageBlock, PlayRequest
    from edoras_tools.io import Source
    from edoras_tools.middleware.graph import Qos
    from edoras_tools.pipelines.workbench import Workbench
    from edoras_tools.ros import TypeStore

_USUAL_LENGTH: Final = 128
_ELLIPSIS: Final = "..."
_ROSIDL_NAMES: Final = {
    "float64": "double",
    "float32": "float",
    "bool": "boolean",
    "byte": "octet",
    "char": "uint8",
}
"""Names of element types in the output of ``--no-arr``."""


class TextOptions(NamedTuple):
    """Form and length of a printed message."""

    field: Annotated[str | None, Option(help="Only this part, e.g. pose.position.")] = None
    csv: Annotated[bool, Option("--csv", help="Values alone, with commas.")] = False
    full_length: Annotated[bool, Option("--full-length", "-f", help="Long values whole.")] = False
    truncate_length: Annotated[
        int | None, Option("--truncate-length", "-l", parser=options.count, help="Cut them here; 128.")
    ] = None
    no_arr: Annotated[bool, Option("--no-arr", help="Name arrays, without values.")] = False
    no_str: Annotated[bool, Option("--no-str", help="Give the length of strings alone.")] = False
    flow_style: Annotated[bool, Option("--flow-style", help="YAML in one line.")] = False
    raw: Annotated[bool, Option("--raw", help="The bytes, as Python writes them.")] = False
    message_info: Annotated[
        bool, Option("--include-message-info", help="Also times, and the publisher's number.")
    ] = False

    def text(self, types: TypeStore, type_name: str, cdr: bytes) -> str:
        """Return a message as text, without a separator.

        Raises:
            ConfigError: the type has no such field.
            WireError: the message does not fit its type.
        """
        import yaml

        value: Any = types.decode(type_name, cdr)
        kind = type_name
        for name in filter(None, (self.field or "").split(".")):
            fields = {item.name: item for item in types.fields(kind)} if isinstance(value, dict) else {}
            if name not in fields:
                hint = f"; there are {', '.join(fields)}" if fields else ""
                raise ConfigError(f"--field {self.field}: {kind} has no field {name!r}{hint}")
            value, kind = value[name], fields[name].type
        prepared = self._prepared(types, kind, value)
        if self.csv:
            return ",".join(_cells(prepared)) + "\n"
        text: str = yaml.dump(
            prepared, allow_unicode=True, sort_keys=False, width=1 << 30, default_flow_style=self.flow_style
        )
        return text if isinstance(prepared, dict | list) else text.removesuffix("...\n")

    def _prepared(self, types: TypeStore, kind: str, value: Any) -> Any:
        """Return a value for YAML, cut if it is long."""
        most = None if self.full_length else self.truncate_length or _USUAL_LENGTH
        if isinstance(value, dict):
            return {item.name: self._member(types, item, value[item.name]) for item in types.fields(kind)}
        if isinstance(value, str) and self.no_str:
            return f"<string length: <{len(value)}>>"
        if isinstance(value, str):
            return value if len(cut := value[:most]) == len(value) else cut + _ELLIPSIS
        if isinstance(value, list | bytes):
            some = [self._prepared(types, kind, item) for item in value[:most]]
            return some + [_ELLIPSIS] * (len(some) < len(value))
        return value

    def _member(self, types: TypeStore, item: MessageField, value: Any) -> Any:
        if not self.no_arr or item.shape is Shape.SCALAR:
            return self._prepared(types, item.type, value)
        kind = _ROSIDL_NAMES.get(item.type, item.type)
        if item.shape is Shape.ARRAY:
            return f"<array type: {kind}[{len(value)}]>"
        bound = f"[{item.size}]" if item.size else ""
        return f"<sequence type: {kind}{bound}, length: {len(value)}>"


def _cells(value: Any) -> Iterator[str]:
    """Yield the values of a message, one for each cell of CSV."""
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _cells(item)
    else:
        yield str(value)


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
        from edoras_tools.addons.ros_verbs.endpoints import GraphRequest
        from edoras_tools.middleware.graph import usual, usual_domain

        ros, domain, pairs = self.graph
        domain = usual_domain() if domain is None else domain
        settings = dict(pairs or ())
        return GraphRequest(ros or usual(), domain, settings, topics, qos.fitting, tell, self.duration)

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
        from edoras_tools.addons.ros_verbs.endpoints import open_source

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
    from edoras_tools.addons.ros_verbs.playing import read_topics

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
    from edoras_tools.addons.ros_verbs.playing import USUAL_WINDOWS, TopicFigures, rate_table, read_topics

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
    from edoras_tools.addons.ros_verbs.endpoints import policies_text, recorded_policies, topics_of_graph

    if source.reads_graph(words):
        return topics_of_graph(source.request(()), decoding.settings())
    from edoras_tools.addons.ros_verbs.playing import topics_in

    rows = []
    for item, profiles, is_published in topics_in(*source.open(words, decoding), source.duration or 0):
        texts = [policies_text(offer) for offer in recorded_policies(profiles)]
        details = {"publishers": [f"Endpoint type: PUBLISHER\n{text}" for text in texts], "subscriptions": ()}
        counts = {"publishers": len(texts) or (1 if is_published else None), "subscriptions": None}
        rows.append({"topic": item.name, "type": item.type, **counts, "details": details})
    return rows


@grouped
def observe(
    *,
    topics: Annotated[
        list[str] | None, Argument(metavar="[TOPIC]...", help="Topics, waited for; else all there are.")
    ] = None,
    graph: RosOptions,
    qos: QosOptions,
    duration: options.Duration = None,
    output: recordings.Output = None,
    force: recordings.Force = False,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Count what ROS 2 nodes exchange.

    By publisher: messages, numbers, those missed, delay; and whose quality of service does not match.
    A recording is a witness for the doctor: doctor CAPTURE --bag FILE. Exit code 3: messages were missed.
    """
    from edoras_tools.addons.ros_verbs.endpoints import open_source
    from edoras_tools.pipelines.capture.record import record
    from edoras_tools.pipelines.reading import Limits, reading

    words, report = Words.of(topics), None
    if words.files:
        raise ConfigError(f"{words.files[0]}: observe looks at a graph; a topic begins with /")
    target = recordings.recording_target(output, force=force)
    graph_options = SourceOptions(duration=duration, graph=graph)
    source, bench = open_source(graph_options.request(words.topics, qos), decoding.settings())
    if not printing.quiet:
        say(f"observing {', '.join(source.topics)} ({source.info.name}); Ctrl-C ends")
    began, limits = monotonic_ns(), Limits(duration_ns=duration or 0)
    if target is not None:
        report = record(source, bench, target, limits=limits, by_route=False)
    else:
        with reading(source, bench, limits=limits) as loop:
            deque(loop, maxlen=0)
    summaries = source.summaries()
    if printing.json:
        seconds, outputs = (monotonic_ns() - began) / 1e9, report.outputs if report else ()
        whole = {"graph": source.info.name, "seconds": round(seconds, 3), "topics": summaries}
        print_json({**whole, "outputs": [str(path) for path in outputs]})
    elif not printing.quiet:
        sys.stdout.write("".join(f"{line}\n" for item in summaries for line in _lines(item)))
    if report is not None:
        finish(report, live=True)
    end(lost=any(item["lost"] or any(one["missed"] for one in item["publishers"]) for item in summaries))


def _lines(topic: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a topic and its endpoints, for people."""
    lost = "" if topic["lost"] is None else f": the middleware lost {topic['lost']:,}"
    yield f"{topic['topic']}  {topic['type']}{lost}"
    for item in topic["publishers"]:
        delay, numbers = item["delay_us"], "no numbers"
        if item["first_sequence"] is not None:
            numbers = f"{item['first_sequence']:,} to {item['last_sequence']:,}, {item['missed']:,} missed"
        parts = [f"{item['received']:,} received", numbers, "left" if item["left"] else ""]
        if delay["p50"] is not None:
            parts.append(f"delay p50 {delay['p50'] / 1000:.2f} ms, p99 {delay['p99'] / 1000:.2f} ms")
        yield f"  publisher     {_name(item)}  {'; '.join(filter(None, parts))}"
    for item in topic["subscriptions"]:
        apart = "; ".join(f"does not match {text}" for text in item["incompatible"])
        yield f"  subscription  {_name(item)}  {apart or ('observes' if item['observer'] else 'matches')}"


def _name(item: Mapping[str, Any]) -> str:
    policies = f"{item['reliability']}, {item['durability']}" if "reliability" in item else "unknown"
    return f"{item['node'] or item['gid'] or 'of several':<20}  {policies}"


_DELAY_NS = 5_000_000_000


class PlayOptions(NamedTuple):
    """The played part of a recording, and the settings of playing."""

    topic: Annotated[list[str] | None, Option(help="Only topics that match, e.g. '/robot_*'.")] = None
    remap: Annotated[list[Any] | None, Option(parser=pair, metavar="A:=B", help="Publish A as B.")] = None
    times: options.TimeOptions = options.TimeOptions()
    speed: Annotated[float | None, Option(parser=factor, help="Factor; default 1.")] = None
    clock: Annotated[
        float | None, Option(parser=factor, metavar="[=HZ]", help="Also publish its time, at 40 Hz.")
    ] = None
    loop: Annotated[int | None, Option(parser=loops, help="How often; default 1; 0: no end.")] = None
    paused: Annotated[bool, Option("--paused", help="Paused at first: n next, space, q quits.")] = False
    delay: Annotated[
        int | None, Option(parser=options.duration, help="Wait for subscriptions at most; 5s.")
    ] = None

    def request(self) -> PlayRequest:
        """Return these options in the form that pipelines take."""
        from edoras_tools.addons.ros_verbs.playing import PlayRequest

        passes, delay = 1 if self.loop is None else self.loop, _DELAY_NS if self.delay is None else self.delay
        topics, renamed, period = tuple(self.topic or ()), dict(self.remap or ()), self.times.period()
        speed, clock = self.speed or 1.0, self.clock or 0.0
        return PlayRequest(topics, renamed, period, speed, clock, passes, self.paused, delay)


@grouped
def play(
    *,
    files: Annotated[list[Path], Argument(metavar="FILE...", help=f"{READ_PACKED}.")],
    graph: RosOptions,
    how: PlayOptions,
    printing: options.PrintOptions,
    decoding: options.DecodingOptions,
) -> None:
    """Publish a recording's messages in ROS 2.

    With the quality of service that their publishers had, at the times of the recording, kept as replay
    keeps them.
    """
    from edoras_tools.addons.ros_verbs import playing
    from edoras_tools.middleware.graph import open_graph, usual, usual_domain
    from edoras_tools.pipelines.messages import open_inputs
    from edoras_tools.pipelines.reading import Keys
    from edoras_tools.render.capture.watch import Followed
    from edoras_tools.render.sending.status import send_status

    (json, quiet), (ros, domain, more), request = printing, graph, how.request()
    ros, domain = ros or usual(), usual_domain() if domain is None else domain
    source, bench = open_inputs(files, decoding.settings())
    with closing(Followed(source, quiet=quiet or json)) as recording:
        loaded = playing.load_messages(recording, bench, request)
    name = f"{ros}, domain {domain}"
    node = open_graph(ros, bench.types, "edoras_play", domain=domain, options=dict(more or ()))
    if not (quiet or json):
        say(f"playing {len(loaded.out):,} messages on {len(loaded.topics)} topics ({name}); Ctrl-C ends")
    keys = Keys() if request.paused or (sys.stdin is not None and sys.stdin.isatty()) else None
    total = len(loaded.out) * request.passes or None
    with send_status(total, quiet=quiet or json, keys=bool(keys)) as watcher:
        report = playing.play(loaded, node, request, bench.mission, name=name, keys=keys, watcher=watcher)
    summary = report.summary()
    if json:
        topics = [{"topic": item.topic, "type": item.type, **asdict(item.qos)} for item in loaded.topics]
        names = "sent", "rate_achieved_hz", "duration_s", "lateness_us", "errors", "notes", "interrupted"
        figures = {key: summary[key] for key in names}
        print_json({"graph": name, "total": report.total, **figures, "topics": topics})
    elif not quiet:
        late = " us, ".join(f"{key} {value}" for key, value in summary["lateness_us"].items())
        sys.stdout.write(
            f"published {report.sent:,} messages in {summary['duration_s']:.1f} s, late by {late} us\n"
        )
    errors = (f"{count:,} not published: {why}" for why, count in report.errors.items())
    end(*summary["notes"], *errors, failure=report.failure, lost=report.errors)
    if report.signalled and report.total:
        raise Exit(INTERRUPTED)
