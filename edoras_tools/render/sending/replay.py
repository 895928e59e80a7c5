"""The result of a replay or an inject: what was sent and what came back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from edoras_tools import words
from edoras_tools.render.severity import Level
from edoras_tools.render.terminal import palette
from edoras_tools.render.terminal.table import facts_grid, plain
from edoras_tools.words import plural

_MOST_EVENTS: Final = 20


def plan(summary: Mapping[str, Any]) -> RenderableType:
    """Return the view of ``--dry-run``."""
    facts = facts_grid()
    many = summary["datagrams"]
    datagrams = "without end" if many is None else plural(many, "datagram")
    facts.add_row("would send", f"{datagrams} to {summary['to']} at {summary['target']}")
    facts.add_row("rate", _rate(summary["rate_asked_hz"]))
    if summary["listen"]:
        as_whom = f" as {summary['sender']}" if summary["sender"] else ""
        facts.add_row("listening", f"at {summary['listen']}{as_whom}")
    if summary["wait_for"]:
        facts.add_row("waits for", ", ".join(summary["wait_for"]))
    for rule in summary["faults"]:
        facts.add_row("fault", plain(rule, palette.STRONG))
    for note in summary["notes"]:
        facts.add_row("note", plain(note))
    return Group(facts, Text(), _routes(summary["routes"]))


def outcome(summary: Mapping[str, Any], target: str) -> RenderableType:
    """Return the view of sent and received messages.

    Args:
        summary: in the shape of ``replay --json``.
        target: target of the datagrams.
    """
    facts = facts_grid()
    over = f" over {words.duration(summary['duration_s'])}" if summary["duration_s"] else ""
    ended = "  (ended early)" if summary["interrupted"] else ""
    facts.add_row("sent", f"{plural(summary['sent'], 'datagram')} to {target}{over}{ended}")
    if summary["rate_achieved_hz"] is not None:
        target_rate = _rate(summary["rate_asked_hz"])
        facts.add_row("rate", f"{words.rate(summary['rate_achieved_hz'])}, asked: {target_rate}")
    late = summary["lateness_us"]
    if late["p50"] is not None:
        facts.add_row("lateness", "  ".join(f"{name} {_micro(late[name])}" for name in ("p50", "p99", "max")))
    for why, count in summary["errors"].items():
        facts.add_row("not sent", Text(f"{count:,}: {why}", Level.ERROR.style))
    if summary["faults"]:
        faults = ", ".join(f"{name} {count:,}" for name, count in sorted(summary["faults"].items()))
        facts.add_row("faults", plain(faults, palette.STRONG))
    for note in summary["notes"]:
        facts.add_row("note", plain(note))
    if ingest := _ingested(summary["ingest"]):
        facts.add_row("read", ingest)
    for item in summary.get("expected", ()):
        style = "" if item["met"] else Level.ERROR.style
        facts.add_row(
            "expected" if item["met"] else "missing", plain(f"{item['expect']}: {item['found']}", style)
        )
    responses = summary["seen"]
    for name, row in responses["counters"].items():
        style = Level.ERROR.style if row["gained"] else palette.DIM
        facts.add_row("counter", Text(f"{name} {row['first']} → {row['last']}", style))
    for event in responses["events"][:_MOST_EVENTS]:
        times = f"  x{event['count']}" if event["count"] > 1 else ""
        style = Level.ERROR.style if event["event_type"] in {"error", "critical"} else ""
        facts.add_row("event", plain(f"{event['app']} {event['event_id']}: {event['message']}{times}", style))
    if len(responses["events"]) > _MOST_EVENTS:
        facts.add_row("event", f"and {len(responses['events']) - _MOST_EVENTS} more")
    if responses["sbn"]:
        facts.add_row("SBN", ", ".join(f"{name} {count:,}" for name, count in responses["sbn"].items()))
    if answers := responses.get("answers"):
        facts.add_row("received", plural(answers, "message"))
    return Group(facts, Text(), _routes(responses["telemetry"])) if responses["telemetry"] else facts


def _ingested(ingest: Mapping[str, Any] | None) -> Text | None:
    """Return how many of the sent datagrams Command Ingest has read, if its count shows it."""
    if ingest is None or ingest["state"] == "unknown":
        return None
    read, sent, missing = ingest["read"], ingest["sent"], ingest["missing"]
    of = f"{words.count(read)} of {words.count(sent)}" if read is not None else ""
    never_came = (
        f"{words.count(missing or 0)} never came to it: its socket was full, or they were lost on the way"
    )
    text, style = {
        "all": (f"all {words.count(sent)} by Command Ingest", ""),
        "missing": (f"{of} by Command Ingest; {never_came}", Level.ERROR.style),
        "waiting": (
            f"{of} by Command Ingest when listening ended; the others may wait in its socket",
            Level.WARNING.style,
        ),
        "partly": (
            f"at least {of} by Command Ingest; the others were sent before its count was known",
            palette.DIM,
        ),
        "others": ("Command Ingest also read what others sent: its count shows nothing", palette.DIM),
        "restarted": ("Command Ingest's count began anew: it shows nothing", Level.WARNING.style),
    }[ingest["state"]]
    return Text(text, style)


def _rate(hertz: float | None) -> str:
    return "as fast as it goes" if hertz is None else words.rate(hertz)


def _micro(microseconds: float) -> str:
    return f"{microseconds:.1f} µs" if microseconds < 999.5 else words.milliseconds(microseconds / 1e3)


def _routes(rows: Sequence[Mapping[str, Any]]) -> Table:
    linked = any(row.get("link") for row in rows)
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, header_style=palette.STRONG)
    for title in ("Link", "MsgId", "Topic", "Count")[not linked :]:
        table.add_column(title, justify="right" if title == "Count" else "left", no_wrap=True)
    for row in rows:
        name = row.get("topic") or row.get("name") or words.NONE
        cells = (plain(row["msg_id"] or words.NONE), plain(name), plain(words.count(row["count"])))
        table.add_row(*((plain((row.get("link") or "").upper()),) if linked else ()), *cells)
    return table
