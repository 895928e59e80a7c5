"""``--metrics``: the figures of a run in the format of Prometheus, over HTTP.

Rules that this file keeps:

1. The figures are the current values of those that ``--json`` prints at the end: one name for each key, lists
   with a label for each text. A null value is left out, never 0.
2. The run computes the figures on request, between two batches; the client waits, the run does not.
"""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from json import dumps
from typing import TYPE_CHECKING, Any, Final

from edoras_tools import __version__
from edoras_tools.cli.output import say, tell_reach
from edoras_tools.errors import os_errors

if TYPE_CHECKING:
    from typing_extensions import Self

    from edoras_tools.model import Endpoint

    _Labels = tuple[tuple[str, str], ...]

_GAUGES: Final = re.compile(
    "rate_hz|jitter_ms|bytes_m(in|ax)|(start|end)_ns|max_rate|gaps|held|waiting|connected|seed|p50|p99|max"
)
"""Keys whose values may fall; all others only grow."""
_LABELS: Final = frozenset({"processor_id", "spacecraft_id"})
"""Keys whose numbers are names."""
_WAIT_S: Final = 3.0
_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


def metrics_text(summary: Mapping[str, Any]) -> str:
    """Return a summary, in the shape of ``--json``, in the text format of Prometheus, version 0.0.4."""
    families: dict[str, tuple[str, dict[_Labels, float]]] = {}
    for keys, labels, number in _samples((), summary, {}):
        gauge = bool(_GAUGES.fullmatch(keys[-1])) or isinstance(number, bool)
        name, value = "_".join(("edoras", *keys)), float(number)
        if name.endswith("_ns"):
            name, value = f"{name.removesuffix('_ns')}_seconds", value / 1e9
        name += "" if gauge else "_total"
        head = f"# HELP {name} {'.'.join(keys)} of --json.\n# TYPE {name} {'gauge' if gauge else 'counter'}\n"
        values = families.setdefault(name, (head, {}))[1]
        key = tuple(sorted(labels.items()))
        values[key] = values.get(key, 0.0) + value  # two rows with the same labels
    texts = {key: value for key, value in summary.items() if isinstance(value, str)}
    info = tuple({"version": __version__, **texts}.items())
    families["edoras_info"] = ("# HELP edoras_info What runs.\n# TYPE edoras_info gauge\n", {info: 1.0})
    return "".join(
        head + "".join(f"{name}{_braced(labels)} {value!r}\n" for labels, value in values.items())
        for name, (head, values) in families.items()
    )


def _samples(
    keys: tuple[str, ...], value: Any, labels: Mapping[str, str]
) -> Iterator[tuple[tuple[str, ...], Mapping[str, str], float]]:
    """Yield the keys, the labels and the value of every number in a summary."""
    if isinstance(value, int | float):
        yield keys, labels, value
    elif isinstance(value, list):
        for item in value:
            if isinstance(item, dict):
                own_labels = {
                    key: str(of) for key, of in item.items() if isinstance(of, str) or (of and key in _LABELS)
                }
                rest = {key: of for key, of in item.items() if key not in own_labels}
                yield from _samples(keys, rest, {**labels, **own_labels})
    elif isinstance(value, dict):
        by_name = keys[-1:] == ("findings",)
        for key, item in value.items():
            more = {"finding": key} if by_name else {}
            yield from _samples(keys if by_name else (*keys, key), item, {**labels, **more})


def _braced(labels: _Labels) -> str:
    inside = ",".join(f"{name}={dumps(text, ensure_ascii=False)}" for name, text in labels)
    return f"{{{inside}}}" if inside else ""


class ServedWatcher:
    """A watcher that also serves the figures of the watched run, while it is entered.

    Args:
        inner: context manager that returns another watcher, or None.
        listen: endpoint to serve at; port 0 for a free one.

    Raises:
        CaptureError: on entering, if it cannot listen there.
    """

    def __init__(self, inner: AbstractContextManager[Any], listen: Endpoint) -> None:
        self._inner, self._listen = inner, listen
        self._stack = ExitStack()
        self._changed = threading.Condition()
        self._asked, self._text = False, ""

    def __enter__(self) -> Self:
        with os_errors(f"--metrics {self._listen}: cannot be listened on"):
            server = _Server((self._listen.address, self._listen.port), _Handler)
        server.text = self._answer
        self._stack.callback(server.server_close)
        host, port = server.server_address[:2]
        say(f"metrics: http://{host!s}:{port}/metrics")
        tell_reach(self._listen, "read the metrics")
        threading.Thread(target=server.serve_forever, name="metrics", daemon=True).start()
        self._stack.callback(server.shutdown)
        self._watcher = self._stack.enter_context(self._inner)
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def update(self, run: Any) -> None:
        """Show the run, and compute its figures if a client requested them."""
        if self._watcher is not None:
            self._watcher.update(run)
        if self._asked:
            text = metrics_text(run.summary())
            with self._changed:
                self._text, self._asked = text, False
                self._changed.notify_all()

    def _answer(self) -> str:
        with self._changed:
            self._asked = True
            self._changed.wait_for(lambda: not self._asked, _WAIT_S)
            return self._text


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    text: Any = None


class _Handler(BaseHTTPRequestHandler):
    timeout = 10
    server: _Server

    def do_GET(self) -> None:
        """Answer with the figures."""
        body = self.server.text().encode() if self.path.split("?")[0] in {"/", "/metrics"} else b""
        self.send_response(200 if body else 404)
        self.send_header("Content-Type", _TYPE)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: Any) -> None:
        """Log nothing."""
