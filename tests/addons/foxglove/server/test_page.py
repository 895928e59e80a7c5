from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import socket
import subprocess
import urllib.request
from contextlib import ExitStack
from urllib.error import HTTPError

import foxglove_client as peer
import numpy as np
import pytest
import waiting
from hypothesis import given
from hypothesis import strategies as st

from edoras_tools.addons.foxglove.server import page
from edoras_tools.addons.foxglove.server import server as foxglove_server
from edoras_tools.addons.foxglove.server.page import OriginCheck
from edoras_tools.addons.foxglove.server.server import FoxgloveServer, ServerOptions
from edoras_tools.errors import ConfigError
from edoras_tools.io.topics.messages import Records
from edoras_tools.io.topics.streams import Topic
from edoras_tools.model import Endpoint

STRING = "std_msgs/msg/String"
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), "")
ROW = {
    "spacecraft": 1,
    "link": "to",
    "msg_id": "0x0827",
    "name": None,
    "count": 7_654,
    "bytes": 1,
    "gaps": 12,
    "largest": 136,
    "rate_hz": 5.0,
    "level": 2,
    "message": "truncated",
    "age_s": 0.1,
    "value": "x=1 <i>",
    "lost": 1_234,
    "uncertain": 0,
    "passed_hz": None,
    "sent_hz": 5.81,
}
PROBLEM = {
    "lost": 1_234,
    "text": "at <pipe>",
    "severity": "error",
    "remedy": "send less",
    "promise": "0 of 9,999 (by the model)",
    "evidence": ["an event"],
    "messages": [],
}
FIGURES = dict.fromkeys(("lost", "duplicated", "superseded", "waiting", "unaccounted", "uncertain"), 0)
HOP = {**FIGURES, "hop": "TO_LAB_TLM_PIPE", "in": 8_888, "out": 7_654, "lost": 1_234, "rate_hz": 3.21}
DOCTOR = {
    "since_ns": None,
    "until_ns": 10**18,
    "datagrams": 11_111,
    "lost": 1_234,
    "unaccounted": 0,
    "uncertain": 7,
    "worst": "error",
    "headline": "1,234 lost <b>",
    "fine": "All else arrived.",
    "problems": [PROBLEM],
    "flows": [
        {
            "link": "to",
            "names": ["/pose<b>"],
            "ends": ["", "ground"],
            "hops": [HOP],
        }
    ],
    "routes": [],
}
LINK = {
    "time_ns": 10**18,
    "silent_s": 0.1,
    "datagrams": 7_654,
    "gaps": 12,
    "rate_hz": 5.0,
    "bytes_per_s": 680,
    "kernel_drops": None,
    "routes": [{**ROW, "topic": "/pose<b>"}],
    "events": [
        {
            "time_ns": 10**18,
            "level": 40,
            "app": "CI_LAB_APP",
            "text": "<script>alert(1)</script>",
            "count": 40,
        }
    ],
    "doctor": None,
}


@pytest.fixture
def serve(types):
    servers = []

    def start(**options):
        options = ServerOptions(Endpoint("127.0.0.1", 0), **options)
        servers.append(FoxgloveServer("a <b>link</b>", [Topic("/a", STRING)], types.definition, options))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


def get(server, path="", **headers):
    """What a browser gets: status, body."""
    request = urllib.request.Request(server.page_url + path, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=waiting.PATIENCE_S) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as error:
        return error.code, error.read().decode()


def test_it_is_one_file_that_loads_nothing_else():
    answer = page.answer("/", page.SharedState(dict, float))
    text = answer.body.decode()
    assert answer.status == 200
    assert not re.findall(r"(?:src|href)\s*=\s*[\"'](?!data:)|@import|url\(", text)
    policy = answer.headers["Content-Security-Policy"]
    for name in ("style", "script"):
        (block,) = re.findall(rf"<{name}>(.*?)</{name}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(block.encode()).digest()).decode()
        assert f"{name}-src 'sha256-{digest}'" in policy
    assert "unsafe" not in policy


def test_what_there_is(serve):
    told = []
    server = serve(origins=OriginCheck((), told.append))
    assert get(server)[1].startswith("<!doctype html>")
    status, body = get(server, "live.json")
    state = json.loads(body)
    assert (status, state["schema"], state["name"], state["link"]) == (200, 1, "a <b>link</b>", None)
    assert state["topics"] == [{"topic": "/a", "type": STRING, "messages": 0}]
    assert get(server, "nowhere") == (404, "There is / for people and /live.json for programs.\n")
    assert server.summary()["connections"] == 0
    assert told == []


@pytest.mark.parametrize(
    ("headers", "query", "status"),
    [
        ({}, "?token=long+enough", 200),
        ({}, "", 401),
        ({}, "?token=other", 401),
        ({"Origin": "https://evil.example"}, "?token=long+enough", 403),
        ({"Origin": "http://localhost:3000"}, "?token=long+enough", 200),
        ({"Host": "evil.example:8765"}, "?token=long+enough", 403),
        ({"Host": "robot.lab"}, "?token=long+enough", 200),
        ({"Host": "192.0.2.7:8765"}, "?token=long+enough", 200),
        ({"Host": "[::1]:8765"}, "?token=long+enough", 200),
    ],
)
@pytest.mark.parametrize("path", ["", "live.json"])
def test_it_has_the_rules_of_the_websocket(serve, path, headers, query, status):
    told = []
    server = serve(token="long enough", origins=OriginCheck(("http://robot.lab",), told.append))
    assert get(server, path + query, **headers)[0] == status
    assert len(told) == (status != 200)


@pytest.mark.long
def test_who_asks_and_never_reads_disturbs_nobody(serve):
    server = serve()
    server.link_state = lambda: {**LINK, "routes": LINK["routes"] * 5000}  # more than a socket holds
    place = (server.endpoint.address, server.endpoint.port)
    with ExitStack() as opened, peer.Client(server.url, 1) as client:
        for _ in range(20):
            idle = opened.enter_context(socket.create_connection(place, waiting.PATIENCE_S))
            idle.sendall(b"GET /live.json HTTP/1.1\r\nHost: localhost\r\n\r\n")
        client.subscribe("/a")
        waiting.until(lambda: server.has_subscribers(0))
        for number in range(50):
            none, time_ns = np.zeros(1, np.int64), np.full(1, number, np.uint64)
            server.publish(Records(np.zeros(1, np.uint16), time_ns, none, none, b""))
        client.until(lambda: len(client.messages) == 50)
        assert len(json.loads(get(server, "live.json")[1])["link"]["routes"]) == 5000
        waiting.until(lambda: len(server._connections) == 1)  # they are let go after a second


def shown_by_chromium(server):
    """The page's elements after some seconds of the browser's own time."""
    options = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=3000", "--dump-dom")
    command = [CHROMIUM, *options, server.page_url]
    text = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True).stdout
    return re.sub(r"<script>.*?</script>", "", text, count=1, flags=re.DOTALL)


@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_a_browser_shows_it_and_takes_nothing_for_markup(serve):
    server = serve()
    server.link_state = lambda: {**LINK, "doctor": DOCTOR}
    shown = shown_by_chromium(server)
    assert "<title>a &lt;b&gt;link&lt;/b&gt;</title>" in shown
    assert re.search(r'id="state"[^>]*>live<', shown)
    assert "/<wbr>pose&lt;b&gt;" in shown
    assert re.search(r'<small class="level2">truncated</small>', shown)
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in shown
    assert "(40 times)" in shown
    assert "lost by this capture" not in shown, "not known"
    assert "1,234 lost &lt;b&gt;" in shown
    assert 'class="card error"' in shown
    assert '<b class="lost">1,234</b> <span>at &lt;pipe&gt;</span>' in shown
    assert "send less; left: 0 of 9,999 (by the model)" in shown
    assert '<span class="hop">TO_LAB_TLM_PIPE</span>' in shown
    assert "\u22121,234" in shown
    assert "up to 7 more may be lost" in shown
    assert '<td class="lost">1,234</td>' in shown
    assert "5 of 5.8" in shown, "8,888 were published, 7,654 came"
    assert '<b>7,654</b><span class="dim"> 3.2/s</span>' in shown
    assert '<span class="hop">ground</span>' in shown
    assert "x=1 &lt;i&gt;" in shown


@pytest.mark.long
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
@pytest.mark.parametrize(
    ("state", "text", "kind"),
    [
        ({"silent_s": 13.2}, "silent for 13 s", "quiet"),
        ({"silent_s": None}, "no traffic yet", "quiet"),
        ({"silent_s": 1.0}, "live", ""),
    ],
)
def test_a_browser_says_that_traffic_stopped(serve, state, text, kind):
    server = serve()
    server.link_state = lambda: {**LINK, **state}
    shown = shown_by_chromium(server)
    assert re.search(rf'id="state"[^>]*class="{kind}"[^>]*>{text}<', shown)
    assert "Not judged yet." in shown


@pytest.mark.parametrize(
    ("link", "lasts"), [(None, 0.25), ({"silent_s": 1.2}, 0.25), ({"silent_s": 0.1}, 1.0)]
)
def test_browsers_that_ask_at_once_share_an_answer(link, lasts):
    now, asked = [0.0], []

    def state():
        asked.append(0)
        return {"asked": len(asked), "link": link}

    shared = page.SharedState(state, lambda: now[0])

    def number():
        return json.loads(shared.text())["asked"]

    assert [number(), number()] == [1, 1]
    now[0] += lasts - 0.01
    assert number() == 1
    now[0] += 0.02
    assert [number(), number()] == [2, 2]
    shared.changed()
    assert [number(), number()] == [3, 3]


@pytest.mark.parametrize(
    ("every_s", "since_s", "wait_ms"), [(0.95, 0.06, 940), (1, 0.8, 1250), (0.2, 0.1, 750)]
)
def test_browsers_ask_again_behind_a_later_change(every_s, since_s, wait_ms):
    now = [5.0]
    shared = page.SharedState(dict, lambda: now[0])
    assert shared.next_ms() == 1000
    for step in (every_s, since_s):
        shared.changed()
        now[0] += step
    assert shared.next_ms() == wait_ms
    now[0] += 3
    assert shared.next_ms() == 1000


BROWSER = b"GET /live.json?token=a HTTP/1.1\r\nHost: 127.0.0.1:8765\r\nConnection: keep-alive\r\n"
SOCKET = b"Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"


def test_a_request_of_a_browser_is_read():
    assert page.plain_request(BROWSER + b"\r\n") == ("/live.json?token=a", "127.0.0.1:8765", None)
    origin = b"oRIGIN:  http://localhost:3000 \r\nAccept: */*\r\n"
    assert page.plain_request(BROWSER + origin + b"\r\n")[2] == "http://localhost:3000"


@pytest.mark.parametrize(
    "data",
    [
        b"",
        BROWSER,
        BROWSER + b"\r\nGET",
        BROWSER + b"Upgrade: websocket\r\n\r\n",
        BROWSER + b"Content-Length: 4\r\n\r\n",
        BROWSER + b"Host: evil.example\r\n\r\n",
        BROWSER + b" folded: 1\r\n\r\n",
        BROWSER + b"bad name: 1\r\n\r\n",
        BROWSER + b"A: \xff\r\n\r\n",
        BROWSER.replace(b"keep-alive", b"close") + b"\r\n",
        BROWSER.replace(b"GET", b"POST") + b"\r\n",
        BROWSER.replace(b"1.1\r", b"1.0\r") + b"\r\n",
    ],
)
def test_anything_else_is_left_to_the_websocket(data):
    assert page.plain_request(data) is None


def received(opened):
    """Status, connection and body of one answer."""
    data = b""
    while b"\r\n\r\n" not in data:
        data += opened.recv(1)
    head = data.decode()
    left = int(re.search(r"Content-Length: (\d+)", head)[1])
    body = b""
    while len(body) < left:
        body += opened.recv(left - len(body))
    return int(head.split()[1]), re.search(r"Connection: (\S+)", head)[1], body


def test_a_connection_is_kept_and_each_request_has_the_rules(serve):
    server = serve(token="a")
    place = (server.endpoint.address, server.endpoint.port)
    with socket.create_connection(place, waiting.PATIENCE_S) as opened:
        for _ in range(3):
            opened.sendall(BROWSER + b"\r\n")
            status, connection, body = received(opened)
            assert (status, connection, json.loads(body)["name"]) == (200, "keep-alive", "a <b>link</b>")
        opened.sendall(BROWSER.replace(b"token=a", b"token=b") + b"\r\n")
        assert received(opened)[:2] == (401, "close")
        assert opened.recv(1) == b""


def test_a_connection_that_is_kept_may_become_a_client(serve):
    server = serve()
    place = (server.endpoint.address, server.endpoint.port)
    with socket.create_connection(place, waiting.PATIENCE_S) as opened:
        opened.sendall(BROWSER + b"\r\n")
        assert received(opened)[0] == 200
        upgrade = BROWSER.replace(b"keep-alive", b"Upgrade") + SOCKET
        opened.sendall(upgrade + b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n")
        assert opened.recv(12) == b"HTTP/1.1 101"


def test_who_asks_again_before_it_has_read_is_closed(serve):
    server = serve()
    server.link_state = lambda: {**LINK, "routes": LINK["routes"] * 5000}  # more than a socket holds
    place = (server.endpoint.address, server.endpoint.port)
    with socket.create_connection(place, waiting.PATIENCE_S) as opened:
        opened.sendall(BROWSER + b"\r\n")
        waiting.until(lambda: any(item.stuck for item in server._connections.values()))
        opened.sendall(BROWSER + b"\r\n")
        assert received(opened)[:2] == (200, "keep-alive")
        assert received(opened)[:2] == (200, "close")
        assert opened.recv(1) == b""


def test_a_connection_that_is_kept_ends_after_a_while(serve, monkeypatch):
    monkeypatch.setattr(foxglove_server, "PATIENCE_S", 0.1)
    server = serve()
    with socket.create_connection((server.endpoint.address, server.endpoint.port), 30) as opened:
        opened.sendall(BROWSER + b"\r\n")
        assert received(opened)[0] == 200
        assert opened.recv(1) == b""


FRIENDS = [
    "https://app.foxglove.dev",
    "https://studio.foxglove.dev",
    "HTTPS://APP.FOXGLOVE.DEV",
    "file://",
    "http://localhost",
    "http://localhost:8080",
    "http://viz.localhost:8080",
    "https://127.0.0.1:3000",
    "http://127.1.2.3",
    "http://[::1]:8080",
]
STRANGERS = [
    "https://evil.example",
    "http://app.foxglove.dev",
    "https://foxglove.dev.evil.example",
    "https://evilfoxglove.dev",
    "https://evil.example/.foxglove.dev",
    "https://localhost.evil.example",
    "http://127.0.0.1.evil.example",
    "http://localhost@evil.example",
    "http://evil.example@localhost",
    "chrome-extension://localhost",
    "http://10.0.0.5:8080",
    "http://[::1",
    "https://localhost#.example",
    "https://localhost?.example",
    "https://localhost\\.example",
    "http://2130706433",
    "file:///etc/passwd",
    "https://app.foxglove.dev, https://evil.example",
    "null",
    "",
]


@pytest.mark.parametrize("origin", FRIENDS)
def test_foxglove_and_this_machines_pages_come_in(origin):
    assert OriginCheck().admits(origin)


@pytest.mark.parametrize("origin", STRANGERS)
def test_all_others_are_kept_out(origin):
    assert not OriginCheck().admits(origin)
    assert not OriginCheck(("https://viz.example.org",)).admits(origin)


def test_who_is_named_comes_in():
    check = OriginCheck(("https://Viz.example.org", "http://*.lab:8080", "http://[fd00::1]:80"))
    assert check.admits("https://viz.example.org")
    assert check.admits("http://a.lab:8080")
    assert check.admits("http://[fd00::1]:80")
    assert check.admits("https://app.foxglove.dev")
    assert not check.admits("http://a.lab:8081")
    assert OriginCheck(("*",)).admits("null")
    assert OriginCheck(("null",)).admits("null")


@pytest.mark.parametrize("text", ["viz.example.org", "https://viz.example.org/", "", "https://a b"])
def test_what_is_no_origin_is_one_line(text):
    with pytest.raises(ConfigError, match="is not an origin; write it like https://"):
        OriginCheck((text,))


@given(st.text())
def test_any_text_may_be_sent(text):
    OriginCheck().admits(text)
    assert not OriginCheck().admits(f"https://{text}.example")
