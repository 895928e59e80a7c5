"""``edoras observe``: counts what publishers and subscriptions of a graph exchange."""

from __future__ import annotations

import sys
from collections import deque
from time import monotonic_ns
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Exit

from edoras_tools.addons.ros_verbs.cli.topics import QosOptions, SourceOptions, Words
from edoras_tools.cli import options, recordings
from edoras_tools.cli.bridge import RosOptions
from edoras_tools.cli.declare import grouped
from edoras_tools.cli.output import LOST, finish, print_json, say
from edoras_tools.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


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
    from edoras_tools.addons.ros_verbs.source import open_source
    from edoras_tools.pipelines.capture.record import record
    from edoras_tools.pipelines.reading import Limits, reading

    words, report = Words.of(topics), None
    if words.files:
        raise ConfigError(f"{words.files[0]}: observe looks at a graph; a topic begins with /")
    target = recordings.recording_target(output, force=force)
    source, bench = open_source(SourceOptions(graph=graph).request(words.topics, qos), decoding.settings())
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
    if any(item["lost"] or any(one["missed"] for one in item["publishers"]) for item in summaries):
        raise Exit(LOST)


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
