from __future__ import annotations

import json
import math
import os
import subprocess
import threading
from collections import Counter
from contextlib import closing, contextmanager
from pathlib import Path

import foxglove_client as peer
import pytest
from effort import LONG, examples
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from places import ROOT

from edoras_tools.addons.foxglove.player import (
    PlaybackOptions,
    RecordingPlayer,
    attach,
    open_recording,
    request_of,
    split_keys,
)
from edoras_tools.addons.foxglove.server.protocol import PlaybackRequest, PlaybackState
from edoras_tools.errors import CaptureError, RouteError
from edoras_tools.io.formats.open import kept_recording
from edoras_tools.model import Endpoint
from edoras_tools.pipelines.capture.record import Target, record
from edoras_tools.pipelines.doctor import Scope
from edoras_tools.pipelines.selection import Period, Selection
from edoras_tools.pipelines.workbench import Settings, open_files

SECOND = 1_000_000_000
NOW = PlaybackState("Playing", 60 * SECOND, 2.0)
START = 50 * SECOND


@pytest.mark.parametrize(
    ("key", "request_"),
    [
        (" ", PlaybackRequest(playing=False, speed=2.0)),
        ("\x1b[c", PlaybackRequest(playing=True, speed=2.0, seek_ns=65 * SECOND)),
        ("\x1bod", PlaybackRequest(playing=True, speed=2.0, seek_ns=55 * SECOND)),
        ("\x1b[a", PlaybackRequest(playing=True, speed=4.0)),
        ("-", PlaybackRequest(playing=True, speed=1.0)),
        ("\x1b[1~", PlaybackRequest(playing=True, speed=2.0, seek_ns=START)),
        ("x", None),
        ("q", None),
        ("\x1b[5~", None),
    ],
)
def test_what_a_key_asks_for(key, request_):
    assert request_of(key, NOW, START) == request_
    assert list(split_keys(f"{key} {key}")) == [key, " ", key]


def test_nothing_is_before_the_start():
    early = PlaybackState("Paused", START + SECOND, 1.0)
    assert request_of("\x1b[d", early, START) == PlaybackRequest(playing=False, speed=1.0, seek_ns=START)
    assert request_of(" ", early, START).playing


@given(st.text(max_size=30))
def test_nothing_that_is_typed_is_lost(text):
    assert "".join(split_keys(text)) == text


ANY = Endpoint("127.0.0.1", 0)
ROVER = ROOT / "samples/captures/a_rover.pcap"
SETTINGS = Settings((ROOT / "samples/missions/rover_ground.yaml",))
TOPICS = 7
SUPPORT = ROOT / "tests/support"
WANTED = ("/cmd_vel", "/telemetry_pose")


@pytest.fixture(scope="module")
def truth():
    """When each message of the two topics was captured."""
    source, bench = open_files([ROVER]), SETTINGS.workbench()
    found = {topic: [] for topic in WANTED}
    for batch in source.batches():
        columns = bench.columns.decode(batch)
        for index, route in enumerate(bench.mission.routes):
            rows = (columns.route == index) & (columns.cdr_length > 0)
            found[route.topic] += batch.time_ns[rows].tolist()
    source.close()
    return found


class Deck:
    """A player in a thread, by a clock that the test moves."""

    def __init__(self, files=(ROVER,), *, scope=None, keys=str, **options):
        self.now = 0
        info, bench, reopen = open_recording(files, SETTINGS)
        chosen = PlaybackOptions(**options)
        self.player = RecordingPlayer(reopen, bench, clock=lambda: self.now, scope=scope, options=chosen)
        self.start, self.end = self.player.range_ns
        self.sink = attach(bench, info, listen=ANY, player=self.player)
        self._thread = threading.Thread(target=self.player.run, args=(self.sink,), kwargs={"keys": keys})
        self._thread.start()

    def client(self):
        return peer.Client(self.sink.server.url, TOPICS)

    def play_all(self):
        """Play all of it, once a client has subscribed to all that there is, however long that takes it."""
        server = self.sink.server
        peer.wait(lambda: server.subscriptions == len(server._channels))

        def begun():
            self.now += SECOND
            return not self.player.waiting

        peer.wait(begun)
        self.now += self.end - self.start

    def subscribe(self, client, *topics):
        client.subscribe(*(topics or WANTED))
        peer.wait(lambda: all(self.wanted(topic) for topic in topics or WANTED))

    def wanted(self, topic):
        names = [item.name for item in self.sink._monitor.topics]
        return self.sink.server.has_subscribers(names.index(topic))

    def stop(self):
        self.player.stop()
        self._thread.join(peer.PATIENCE_S)
        assert not self._thread.is_alive()


@contextmanager
def deck(**options):
    made = Deck(**options)
    try:
        yield made
    finally:
        made.stop()


def times(client, topic):
    return [item.time_ns for item in client.on(topic)]


def reached(client, deck, position, topic, due):
    """Wait until playback shows this time; then what was due before has come on a topic, and nothing else.

    The clock may overtake messages on the way, messages never each other.
    """
    client.until(lambda: client.times and client.times[-1] == position)
    client.until(lambda: len(client.on(topic)) >= len(due))
    assert times(client, topic) == due


def test_messages_come_when_they_are_due(truth):
    with deck(paused=True) as player, player.client() as client:
        player.subscribe(client)
        assert client.control(play=True)[:2] == ("playing", player.start)
        for seconds in (5, 7, 7.5):
            player.now = int(seconds * SECOND)
            until = player.start + player.now
            for topic in WANTED:
                reached(client, player, until, topic, [time for time in truth[topic] if time <= until])


def test_playing_begins_when_somebody_has_come_and_subscribed():
    with deck() as player:
        player.now = 100 * SECOND
        assert player.player.state.time_ns == player.start
        with player.client() as client:
            client.until(lambda: client.states)
            assert client.states[0][:2] == ("playing", player.start)
            player.now += 4 * SECOND
            client.until(lambda: client.times)
            assert client.times[-1] == player.start, "it may still subscribe"
            player.subscribe(client)

            def gone_on():
                player.now += SECOND
                return client.times and client.times[-1] > player.start + 10 * SECOND

            client.until(gone_on)


def test_paused_is_paused(truth):
    with deck(paused=True) as player, player.client() as client:
        player.subscribe(client)
        client.until(lambda: client.states)
        assert client.states[0] == ("paused", player.start, 1.0, False, "")
        client.control(play=True, request="on")
        player.now = 4 * SECOND
        for topic in WANTED:
            until = player.start + player.now
            reached(client, player, until, topic, [time for time in truth[topic] if time <= until])
        assert client.control(play=False, request="off")[:2] == ("paused", player.start + 4 * SECOND)
        before = len(client.messages)
        player.now = 40 * SECOND
        client.drain(0.2)
        assert len(client.messages) == before
        assert player.player.state.time_ns == player.start + 4 * SECOND
        assert client.control(play=True, request="again")[:2] == ("playing", player.start + 4 * SECOND)
        player.now = 42 * SECOND
        client.until(lambda: client.times[-1] == player.start + 6 * SECOND)


def test_rate_is_times_the_recorded_speed(truth):
    with deck(paused=True, speed=2.0) as player, player.client() as client:
        player.subscribe(client)
        assert client.control(play=True, speed=2.0, request="twice").speed == 2.0
        player.now = SECOND
        client.until(lambda: client.times and client.times[-1] == player.start + 2 * SECOND)
        assert client.control(play=True, speed=8.0, request="more").speed == 8.0
        player.now = 3 * SECOND
        until = player.start + 18 * SECOND
        reached(client, player, until, "/cmd_vel", [time for time in truth["/cmd_vel"] if time <= until])


@pytest.mark.parametrize("backwards", [False, True])
def test_a_jump_shows_what_is_then_and_goes_on_from_there(truth, backwards):
    with deck(paused=True) as player, player.client() as client:
        player.subscribe(client)
        if backwards:
            client.control(play=False, seek_ns=player.end, request="end")
            client.until(
                lambda: {item.time_ns for item in client.messages} >= {max(truth[t]) for t in WANTED}
            )
            client.messages.clear()
        target = player.start + 30 * SECOND
        answer = client.control(play=False, seek_ns=target, request="jump")
        assert answer == ("paused", target, 1.0, True, "jump")
        # Each topic as it stands there, and nothing that is later.
        there = {max(time for time in truth[topic] if time <= target) for topic in WANTED}
        client.until(lambda: there <= {item.time_ns for item in client.messages})
        assert max(item.time_ns for item in client.messages) <= target
        assert len(client.messages) <= 4
        client.messages.clear()
        client.control(play=True, request="on")
        player.now = 3 * SECOND
        until = target + 3 * SECOND
        due = [time for time in truth["/cmd_vel"] if target < time <= until]
        reached(client, player, until, "/cmd_vel", due)


def test_the_end_is_told_and_play_begins_anew():
    with deck(paused=True) as player, player.client() as client:
        player.subscribe(client, "/telemetry_pose")
        client.control(play=True, request="on")
        player.now = player.end - player.start + SECOND
        client.until(lambda: client.states[-1].status == "ended")
        assert client.states[-1].time_ns == player.end
        client.until(lambda: len(client.on("/telemetry_pose")) == 63)
        answer = client.control(play=True, request="again")
        assert answer[:2] == ("playing", player.start)
        assert answer.seeked
        player.now += player.end - player.start
        client.until(lambda: client.states[-1].status == "ended" and client.states[-1].request == "")
        client.until(lambda: len(client.on("/telemetry_pose")) == 126)


def test_whatever_is_asked_playback_stays_inside_the_recording():
    with deck(paused=True) as player:
        ask = player.player.control
        for speed in (math.nan, math.inf, -1.0, 0.0, 1e30):
            assert ask(PlaybackRequest(playing=False, speed=speed)).speed == 1.0
        assert ask(PlaybackRequest(playing=False, speed=1.0, seek_ns=0)).time_ns == player.start
        assert ask(PlaybackRequest(playing=False, speed=1.0, seek_ns=1 << 63)).time_ns == player.end


def test_statistics_begin_anew_where_playback_jumps_to():
    with deck(paused=True) as player, player.client() as client:
        player.subscribe(client, "/edoras/link_statistics")
        client.control(play=False, seek_ns=player.start + 30 * SECOND, request="jump")
        client.control(play=True, request="on")
        player.now = 5 * SECOND
        client.until(lambda: len(client.messages) > 20)
        assert min(times(client, "/edoras/link_statistics")) > player.start + 30 * SECOND


def test_a_chosen_time_is_played(truth):
    zero = int(next(iter(open_files([ROVER]).batches())).time_ns[0])
    times = [item - zero for item in truth["/cmd_vel"]]
    period = Period(10 * 10**9, 20 * 10**9)
    with deck(paused=True, scope=Scope(Selection(topics=("/cmd_vel",)), period)) as player:
        start, end = player.player.range_ns
    assert start - zero == min(item for item in times if item >= period.start_ns)
    assert end - zero == max(item for item in times if item < period.end_ns)
    with pytest.raises(CaptureError, match="its times go from 0 to 65"):
        Deck(scope=Scope(period=Period(10**13)))


def test_only_what_was_chosen_is_played(truth):
    with deck(paused=True, scope=Scope(Selection(topics=("/telemetry_pose",)))) as player:
        assert player.player.range_ns == (min(truth["/telemetry_pose"]), max(truth["/telemetry_pose"]))
    with pytest.raises(RouteError, match="no configured topic matches"):
        Deck(scope=Scope(Selection(topics=("/nowhere",))))
    with pytest.raises(CaptureError, match="it contains no selected datagram"):
        Deck(scope=Scope(Selection(msg_ids=(0x1FFF,))))


def test_a_recording_that_is_cut_off_is_played_as_far_as_it_goes(tmp_path):
    cut = tmp_path / "cut.pcap"
    cut.write_bytes(ROVER.read_bytes()[:60_000])
    with deck(files=(cut,), paused=True) as player:
        assert isinstance(player.player.failure, CaptureError)
        assert player.end > player.start


def test_what_cannot_be_read_twice_cannot_be_played(tmp_path, monkeypatch):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CaptureError, match="playback reads it several times"):
        open_recording([tmp_path / "pipe"], SETTINGS)
    with ROVER.open("rb") as piped:
        monkeypatch.setattr("sys.stdin", piped)
        with closing(kept_recording(Path("-"))) as source:
            assert sum(map(len, source.batches())) == 1827, "it is shown as it comes"
    with pytest.raises(CaptureError):
        open_recording([tmp_path / "nothing.pcap"], SETTINGS)


def test_a_recording_through_a_pipe_is_kept_and_opened_again(tmp_path, monkeypatch):
    path = tmp_path / "a.mcap"
    record(open_files([ROVER]), SETTINGS.workbench(), Target(path))
    with path.open("rb") as piped:
        monkeypatch.setattr("sys.stdin", piped)
        info, _, reopen = open_recording([kept_recording(Path("-"))], SETTINGS)
    assert info.name == "-"
    for _ in range(2):
        source = reopen()
        assert sum(map(len, source.batches())) == 1827
        source.close()


def test_times_that_step_back_are_played_in_the_order_they_were_captured(tmp_path):
    """A frame whose time is before its predecessor's does not wait, and holds up nobody."""
    data = bytearray(ROVER.read_bytes())
    at = 24
    for _ in range(400):
        at += 16 + int.from_bytes(data[at + 8 : at + 12], "little")
    seconds = int.from_bytes(data[at : at + 4], "little")
    data[at : at + 4] = (seconds - 5).to_bytes(4, "little")
    path = tmp_path / "back.pcap"
    path.write_bytes(data)
    with deck(files=(path,), paused=True) as player, player.client() as client:
        player.subscribe(client)
        client.control(play=True)
        player.now = player.end - player.start
        client.until(lambda: client.states[-1].status == "ended")
        client.until(lambda: len(client.on("/cmd_vel")) == 600)


NPM = ROOT / ".npm"
ABSENT = NPM / "absent"
WHY = ABSENT.read_text().strip() if ABSENT.exists() else "Foxglove's client is not installed: make npm"


@pytest.mark.quick("foxglove.sdk.v1")
@pytest.mark.skipif(not (NPM / ".installed").exists(), reason=WHY)
@pytest.mark.parametrize("subprotocol", ["foxglove.websocket.v1", "foxglove.sdk.v1"])
def test_who_subscribes_at_once_loses_nothing(subprotocol, tmp_path):
    """Clients of Foxglove's own library, several at a time, get all that a recording of the same has."""
    path = tmp_path / "a.mcap"
    record(open_files([ROVER]), SETTINGS.workbench(), Target(path))
    with path.open("rb") as file:
        messages = make_reader(file).iter_messages()
        recorded = Counter(channel.topic for _, channel, _ in messages)
    del recorded["/edoras/link_statistics"]  # its last second ends with the recording
    assert {"/cmd_vel", "/edoras/datagrams", "/cfs/CFE_ES_HousekeepingTlm"} <= recorded.keys()
    with subprocess.Popen(
        ["node", SUPPORT / "foxglove_subscriber.mjs", NPM, subprotocol],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as clients:
        for _ in range(examples(5, least=1)):
            decks = [Deck() for _ in range(10 if LONG else 4)]
            for player in decks:
                clients.stdin.write(f"{player.sink.server.url} {player.end} {recorded.total()}\n")
            clients.stdin.flush()
            for player in decks:
                player.play_all()
            told = [json.loads(clients.stdout.readline()) for _ in decks]
            for player in decks:
                player.stop()
            for item in told:
                assert item["protocol"] == subprotocol
                # The library knows no state of playback, which is told to clients of this subprotocol.
                state = "Unrecognized server opcode in binary message: 5"
                assert all(state in text for text in item["errors"])
                assert bool(item["errors"]) is (subprotocol == "foxglove.sdk.v1")
                assert {topic: item["messages"][topic] for topic in recorded} == recorded
            assert sum(player.sink.summary()["dropped"] for player in decks) == 0
        clients.stdin.close()


def test_keys_steer_and_clients_are_told():
    typed = []
    with deck(keys=lambda: typed.pop() if typed else "", paused=True) as player, player.client() as client:
        typed.append(" ")
        client.until(lambda: client.states and client.states[-1].status == "playing")
        typed.append("\x1b[c\x1b[c+")
        client.until(lambda: client.states[-1][1:3] == (player.start + 10 * SECOND, 2.0))
        typed.append("q")
        player._thread.join(peer.PATIENCE_S)
        assert not player._thread.is_alive()


def test_without_waiting_it_plays_at_once_and_a_loop_starts_again(truth):
    with deck(wait=False, loop=True) as player:
        assert not player.player.waiting
        player.now = player.end - player.start
        peer.wait(lambda: player.player.state.time_ns == player.start)
        with player.client() as client:
            player.subscribe(client)
            assert player.player.state.status == "Playing"
            player.now += 3 * SECOND
            due = [time for time in truth["/cmd_vel"] if time <= player.start + 3 * SECOND]
            client.until(lambda: times(client, "/cmd_vel")[-1:] == due[-1:])
    with deck() as player:
        assert player.player.waiting


def test_samples_of_dds_are_offered_and_played_also_those_in_fragments():
    counts = {"/dds/cmd_vel": 100, "/image": 4}
    files = [ROOT / "samples/rtps/fastdds_sender.pcap.gz"]
    with deck(files=files, paused=True) as player, player.client() as client:
        client.until(lambda: client.channels.keys() >= counts.keys())
        client.subscribe(*counts)
        peer.wait(lambda: player.sink.server.subscriptions == len(counts))
        client.control(play=True)
        player.now = player.end - player.start + SECOND
        client.until(lambda: {topic: len(client.on(topic)) for topic in counts} == counts)
