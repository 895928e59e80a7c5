"""``edoras host``: what this machine's kernel drops, and the limits that make cFS lose messages."""

from __future__ import annotations

import sys
import time

from msgspec.structs import asdict

from edoras_tools import doors
from edoras_tools.cli import options
from edoras_tools.cli.options import grouped
from edoras_tools.cli.output import end, print_json
from edoras_tools.links import usual_ports


@grouped
def host(*, json: options.Json = False, decoding: options.DecodingOptions) -> None:
    """Show what this machine's kernel dropped; what to change.

    Of the links' datagrams, by full sockets, lost fragments and interfaces.

    The ports are those of the links, of the mission files (-c) and of --set port. No privilege is
    needed.
    """
    from edoras_tools.io.host import advice, read_host, steal
    from edoras_tools.render.capture.host import host_lines

    links = _ports(decoding)
    counters = read_host(links, time.time_ns())
    hints, share = list(advice(counters)), steal(counters)
    if json:
        sockets = [asdict(item) for item in counters.sockets]
        print_json({**asdict(counters), "sockets": sockets, "steal": share, "advice": hints})
    else:
        sys.stdout.writelines(f"{line}\n" for line in host_lines(counters, links, share, hints))
    end(lost=any(item.drops for item in counters.sockets))


def _ports(decoding: options.DecodingOptions) -> dict[int, str]:
    """Return the UDP ports of the links, each with the labels of its links; load links only if needed."""
    if decoding == options.DecodingOptions() and not doors.installed("links"):
        return usual_ports()
    context = decoding.settings().context()
    return {
        port: "/".join(link.label for link in context.claimants[context.claim[port]])
        for port in context.capture_ports()
    }
