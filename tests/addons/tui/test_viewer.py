"""The view as its user has it: open, move, filter, search, mark, and how the panes hang together."""

import os
import signal

import merging
import pytest
import rewriting
from effort import LONG, every
from places import ROOT
from textual.events import MouseScrollDown

from edoras_tools.addons.tui.prompts import Sheet
from edoras_tools.decode.filters.filter import Where
from edoras_tools.io.formats.open import open_file
from edoras_tools.links.sbn import SBN
from edoras_tools.pipelines.selection import Selection
from edoras_tools.words import TimeFormat


def test_a_file_opens_with_its_first_packet(drive):
    async def script(hands):
        app = hands.app
        assert (app.store.packets, len(app.store), hands.number) == (1544, 1544, 1)
        assert "1,544 packets" in str(app.filter_line.count.render())
        shown = hands.lines(app.packets)
        assert shown[0].split()[:4] == ["1", "0.000000", "2234→2235", "SBN"]
        assert len(shown) == app.packets.page

    drive(script)


@pytest.mark.quick("size2")
@pytest.mark.parametrize("size", [(80, 24), (160, 50), (40, 12)])
def test_any_size_shows_a_list_and_keys(drive, size):
    async def script(hands):
        assert hands.lines(hands.app.packets)[0].strip().startswith("1 ")
        await hands.press("G")
        await hands.until(lambda: hands.number == 1544)
        await hands.pilot.resize_terminal(100, 30)
        await hands.until(
            lambda: any("1544" in line for line in hands.lines(hands.app.packets)), "the cursor"
        )

    drive(script, size=size)


@pytest.mark.long
@pytest.mark.parametrize("width", [60, 80, 100, 160])
def test_what_is_wrong_is_readable_to_its_last_word(drive, width):
    async def script(hands):
        await hands.go(1321)
        await hands.until(lambda: "truncated" in " ".join(hands.lines(hands.app.layers)), "the packet")
        shown = " ".join(" ".join(hands.lines(hands.app.layers)).split())
        assert "and an app that gets a cut one cannot read it, or reads old bytes of its buffer." in shown
        assert "stopped sbn at byte 0 needs 11 bytes, 5 are there" in shown

    drive(script, size=(width, 60))


def test_keys_move(drive):
    async def script(hands):
        page = hands.app.packets.page
        for keys, number in [
            (("up",), 1),
            (("j", "down", "down", "k"), 3),
            (("G",), 1544),
            (("end", "k"), 1543),
            (("home", "j"), 2),
            (("g",), 1),
            (("pagedown",), page),
            (("pageup",), 1),
            (("ctrl+d",), 1 + round((page - 1) / 2)),
            (("ctrl+u",), 1),
        ]:
            await hands.press(*keys)
            await hands.until(lambda number=number: hands.number == number, keys)

    drive(script)


def test_choosing_a_field_highlights_its_bytes(drive):
    async def script(hands):
        app = hands.app
        await hands.go(189)
        await hands.press("enter")
        assert app.focused is app.layers
        await hands.press("G")
        while app.layers.field.value != "0.2":
            await hands.press("k")
        field = app.layers.field
        assert field.label == "x"
        await hands.until(lambda: app.hex_pane.field == (field.start, field.end), "its bytes")
        await hands.until(
            lambda: f"bytes {field.start}-{field.end - 1}" in hands.status, "and where they are"
        )
        # What is drawn under the highlight is what the field was read from.
        style = app.hex_pane.get_component_rich_style("hex-pane--field")
        lines = [app.hex_pane.render_line(line) for line in range(app.hex_pane.page)]
        painted = [
            part.text for line in lines for part in line if part.style and part.style.bgcolor == style.bgcolor
        ]
        octets = "".join(part for part in painted if len(part.strip()) == 2 and "·" not in part)
        assert octets == app.decoded.datagram.payload[field.start : field.end].hex()

    drive(script)


@pytest.mark.long
def test_choosing_a_byte_selects_its_field(drive):
    async def script(hands):
        app = hands.app
        await hands.go(189)
        await hands.press("tab", "tab")
        assert app.focused is app.hex_pane
        layer = app.decoded.layer("cfe_telemetry")
        seconds = next(item for item in layer.fields if item.name == "seconds")
        await hands.press("j", *"l" * (seconds.start - app.hex_pane.per_line + 1))
        await hands.until(lambda: app.layers.field.label == "seconds", "its field")
        await hands.until(lambda: app.hex_pane.field == (seconds.start, seconds.end), "all of its bytes")
        assert app.hex_pane.at == seconds.start + 1

    drive(script)


@pytest.mark.long
def test_the_mouse_chooses_packets_fields_and_bytes(drive):
    async def script(hands):
        app = hands.app
        await hands.pilot.click(app.packets, offset=(30, 4))
        await hands.until(lambda: hands.number == 5)
        line = next(line for line in range(9) if "msg_type" in hands.lines(app.layers)[line])
        await hands.pilot.click(app.layers, offset=(14, line))
        await hands.until(lambda: app.hex_pane.field == (2, 3), "the field's byte")
        assert app.layers.field.label == "msg_type"
        gutter = app.hex_pane.gutter.left
        for column, at in ((6, 0), (9, 1), (12, 2)):
            await hands.pilot.click(app.hex_pane, offset=(gutter + column, 0))
            assert app.hex_pane.at == at
        await hands.until(lambda: app.layers.field.label == "msg_type", "the byte's field")
        before = app.packets.scroll_offset.y
        await hands.pilot._post_mouse_events([MouseScrollDown], app.packets, offset=(5, 5))
        assert app.packets.scroll_offset.y > before

    drive(script)


@pytest.mark.long
def test_every_byte_of_every_layer_finds_a_field_that_holds_it(drive):
    async def script(hands):
        for number in (188, 1345):
            await hands.go(number)
            layers = hands.app.layers
            for layer in hands.app.decoded.layers:
                for at in range(layer.start, layer.end):
                    assert layers.choose_byte(at)
                    assert layers.field.start <= at < layers.field.end

    drive(script)


@pytest.mark.long
def test_branches_close_and_stay_closed(drive):
    async def script(hands):
        layers = hands.app.layers
        await hands.press("enter", "j", "j")
        assert layers.field.role == "layer"
        many = layers.rows()
        await hands.press("h")
        assert layers.rows() < many
        assert any("▸ Software Bus Network" in line for line in hands.lines(layers))
        hands.app.packets.go(1)
        await hands.until(lambda: hands.number == 2)
        assert any("▸ Software Bus Network" in line for line in hands.lines(layers))
        assert layers.choose_byte(0)
        assert layers.rows() == many
        await hands.press("minus")
        assert layers.rows() < many
        await hands.press("asterisk")
        assert layers.rows() == many

    drive(script)


def test_a_filter_shows_what_it_lets_pass_and_keeps_the_packet(drive):
    async def script(hands):
        app = hands.app
        await hands.go(189)
        await hands.filter("msg_id == 0x082a")
        await hands.settle()
        assert app.focused is app.packets
        assert len(app.store) == 57
        assert hands.number == 189
        assert {int(block.columns.msg_id[row]) for block, _, shown in app.store.parts() for row in shown} == {
            0x82A
        }
        assert "57 of 1,544" in str(app.filter_line.count.render())
        await hands.filter("")
        await hands.settle()
        assert len(app.store) == 1544
        assert hands.number == 189

    drive(script)


@pytest.mark.long
def test_a_filter_that_nothing_passes_says_so(drive):
    async def script(hands):
        await hands.filter("msg_id == 0x0999")
        await hands.settle()
        assert len(hands.app.store) == 0
        assert "no packet passes the filter" in hands.lines(hands.app.packets)[1]
        assert hands.app.decoded is None
        # No key may trip over an empty list.
        for key in (
            "j",
            "G",
            "m",
            "enter",
            "w",
            "n",
            "escape",
            "right_square_bracket",
            "s",
            "r",
            "b",
            "escape",
        ):
            await hands.press(key)

    drive(script)


def test_a_filter_that_fails_says_so(drive, monkeypatch):
    def fail(*_):
        raise ZeroDivisionError("by a test")

    monkeypatch.setattr(Where, "mask", fail)

    async def script(hands):
        await hands.filter("msg_id == 0x082a")
        said = "the filter failed: ZeroDivisionError: by a test"
        await hands.until(lambda: said in hands.status, "the failure is told")
        assert said in hands.lines(hands.app.packets)[1]
        assert hands.app.store.settled == 0
        monkeypatch.undo()
        await hands.filter("msg_id == 0x082a")
        await hands.settle()
        assert len(hands.app.store) == 57, "the thread still runs"

    drive(script)


def test_a_wrong_filter_is_shown_with_a_caret_at_the_character(drive):
    async def script(hands):
        app = hands.app
        wrong = [
            ("msg_id == 0x827 and pse.position.x > 1", 20, "did you mean pose.position.x"),
            ("msg_id = 1", 7, "equality is written =="),
            ("link ==", 7, "a value belongs"),
        ]
        for text, at, words in every(3, wrong):
            await hands.filter(text)
            line = app.filter_line
            assert app.focused is line.input
            assert line.wrong.display
            told = str(line.wrong.render())
            assert words in " ".join(told.split())
            assert told.splitlines()[0].index("^") == line.input.region.x + at
            assert line.input.has_class("-wrong")
            assert len(app.store) == 1544
            await hands.press("escape")
            assert app.focused is app.packets

    drive(script)


@pytest.mark.long
def test_completions_are_shown_chosen_and_accepted(drive):
    async def script(hands):
        line, offered = hands.app.filter_line.input, hands.app.filter_line.completions
        await hands.press("f")
        await hands.press(*"rq", "backspace", "ctrl+u")
        assert not offered.display
        await hands.press(*"pose.posi")
        assert offered.words == ["pose.position.x", "pose.position.y", "pose.position.z"]
        assert all(word in str(offered.render()) for word in (*offered.words, "Tab accepts"))
        await hands.press("down", "tab")
        assert line.value == "pose.position.y"
        assert not offered.display, "it is complete"
        await hands.write(" > 0")
        assert line.has_class("-right")

    drive(script)


@pytest.mark.long
def test_values_are_completed_too(drive):
    async def script(hands):
        line, offered = hands.app.filter_line.input, hands.app.filter_line.completions
        for typed, words, value in (
            ("link == s", ["sbn"], "link == sbn"),
            ("topic == /robot_1/c", ["/robot_1/cmd_vel"], "topic == /robot_1/cmd_vel"),
            ("link in {ci, t", ["to"], "link in {ci, to"),
            ("(apid == 3 and lin", None, "(apid == 3 and link"),
            ("nothing == a", [], None),
            ("link == zzz", [], None),
            ("not ", [], None),
        ):
            await hands.press("f")
            line.value = ""
            await hands.rest()
            await hands.write(typed)
            assert words is None or offered.words == words, typed
            if value is not None:
                await hands.press("tab")
                assert line.value == value
            else:
                assert not offered.display, typed
                await hands.press("down")
                assert hands.app.focused is hands.app.packets, typed

    drive(script)


@pytest.mark.long
def test_escape_first_closes_the_completions(drive):
    async def script(hands):
        offered = hands.app.filter_line.completions
        await hands.press("f")
        await hands.write("lin")
        await hands.press("escape")
        assert not offered.display
        assert hands.app.focused is hands.app.filter_line.input
        await hands.press("escape")
        assert hands.app.focused is hands.app.packets

    drive(script)


@pytest.mark.quick("mcap")
@pytest.mark.parametrize("suffix", ["pcap", "pcapng", "mcap"])
def test_what_the_list_shows_is_saved(drive, tmp_path, suffix):
    path = tmp_path / f"new/some.{suffix}"

    async def script(hands):
        await hands.filter("link == sbn and msg_id == 0x082a")
        await hands.settle()
        shown = [hands.app.store.datagram(row) for row in range(len(hands.app.store))]
        for told in (f"{path}: {len(shown)} packets", "exists; name another output"):
            await hands.press("W")
            await hands.write(str(path))
            await hands.press("enter")
            await hands.until(lambda told=told: told in hands.status, told)
        source = open_file(path)
        saved = [batch[row] for batch in source.batches() for row in range(len(batch))]
        source.close()
        assert [(item.time_ns, item.payload) for item in saved] == [
            (item.time_ns, item.payload) for item in shown
        ]

    drive(script, size=(200, 40))


@pytest.mark.long
def test_what_cannot_be_saved_is_one_line(drive, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    async def script(hands):
        await hands.press("W")
        await hands.write("a.txt")
        await hands.press("enter")
        await hands.until(lambda: "unknown suffix" in hands.status, "the reason")
        assert not list(tmp_path.iterdir())

    drive(script)


@pytest.mark.long
def test_the_filter_of_the_command_line_is_the_first(drive):
    async def script(hands):
        await hands.settle()
        assert len(hands.app.store) == 57
        assert hands.app.store.packets < 1544
        assert hands.app.filter_line.input.value == "msg_id == 0x082a"

    drive(script, selection=Selection(links=(SBN,), where="msg_id == 0x082a"))


@pytest.mark.long
def test_a_field_becomes_a_filter(drive):
    async def script(hands):
        app = hands.app
        await hands.go(188)
        assert app.layers.choose_byte(7)
        await hands.press("enter", "equals_sign")
        assert app.filter_line.input.value == "cfe_command.checksum == 0x00"
        await hands.press("enter")
        await hands.settle()
        assert 0 < len(app.store) < 1544
        assert hands.number == 188

    drive(script)


def test_search_goes_to_the_next_and_round_the_end(drive):
    async def script(hands):
        for text in every(2, ("Peer 66:3 connected", "msg_id == 0x1829")):
            await hands.press("g", "slash")
            hands.app.prompt.input.value = ""
            await hands.write(text)
            await hands.press("enter")
            await hands.until(lambda: hands.number > 1, "found")
            first = hands.number
            await hands.press("n")
            await hands.until(lambda first=first: hands.number != first, "the next")
            await hands.press("N")
            await hands.until(lambda first=first: hands.number == first, "the one before")
            await hands.press("G", "n")
            await hands.until(lambda first=first: hands.number == first, "from the beginning again")
        await hands.press("slash")
        await hands.write(" and no such thing")
        await hands.press("enter")
        await hands.until(lambda: "no packet shown contains" in hands.status)
        assert hands.number == first

    drive(script)


@pytest.mark.long
def test_marks_are_gone_between_and_filtered_for(drive):
    async def script(hands):
        app = hands.app
        for number in (10, 700, 300):
            await hands.go(number)
            await hands.press("m")
        assert app.packets.marks == {10, 300, 700}
        assert hands.lines(app.packets)[app.packets.cursor - app.packets.scroll_offset.y].startswith("◆")
        for key, number in (("right", 700), ("right", 10), ("left", 700)):
            await hands.press(f"{key}_square_bracket")
            await hands.until(lambda number=number: hands.number == number, key)
        await hands.press("m")
        assert app.packets.marks == {10, 300}
        await hands.press("M")
        await hands.settle()
        assert len(app.store) == 2

    drive(script)


@pytest.mark.long
def test_routes_are_counted_and_filter(drive):
    async def script(hands):
        app = hands.app
        await hands.press("r")
        await hands.until(lambda: "/robot_1/cmd_vel" in "\n".join(hands.lines(app.routes)), "the routes")
        assert app.routes._rows[0]["count"] == 185
        await hands.press("j", "j", "enter")
        await hands.settle()
        assert app.filter_line.input.value == "link == sbn and msg_id == 0x082a and processor_id == 1"
        assert len(app.store) == 57

    drive(script)


@pytest.mark.long
def test_routes_are_sorted_by_any_column(drive):
    titles = ["Link", "MsgId", "Topic", "Count", "Mean", "Jitter", "Gaps", "Bytes"]

    async def script(hands):
        routes = hands.app.routes
        await hands.press("r")
        await hands.until(lambda: routes.rows() > 5, "the routes")
        await hands.until(lambda: titles[0] in str(routes.header()), "drawn in their size")
        first = list(routes._rows)
        for title in titles if LONG else titles[:4]:
            await hands.press("o")
            assert routes._sorted == title
            assert f"{title} ▼" in str(routes.header())
        if LONG:
            await hands.press("o")
            assert not routes._sorted
            assert routes._rows == first, "in the order of the first packets again"
            await hands.press("o", "o", "o", "o")
        assert [row["count"] for row in routes._rows] == sorted((row["count"] for row in first), reverse=True)
        chosen = routes.filter
        await hands.press("O")
        assert [row["count"] for row in routes._rows] == sorted(row["count"] for row in first)
        assert routes.filter == chosen, "the cursor stays on its route"

    drive(script)


@pytest.mark.long
def test_rates_are_those_of_the_packets_shown(drive):
    async def script(hands):
        app = hands.app
        await hands.press("R")
        await hands.until(lambda: app.rates._figure is not None, "the graph")
        lines = app.rates._figure.panels[0].lines
        assert sum(line.read for line in lines) == 1544
        assert len(lines) == 6
        assert lines[-1].label.endswith(" others")
        await hands.until(lambda: "packets of the list" in "\n".join(hands.lines(app.rates)), "its heading")
        await hands.filter("link == sbn and msg_id == 0x082a")
        await hands.settle()
        figure = lambda: app.rates._figure  # noqa: E731
        await hands.until(
            lambda: figure() and len(figure().panels[0].lines) == 1, "the graph of what is left"
        )
        (line,) = app.rates._figure.panels[0].lines
        assert (line.label, line.read) == ("sbn /robot_1/cmd_vel", 57)
        await hands.filter("length == 1")
        await hands.until(lambda: app.rates._figure is None, "nothing is left")
        await hands.until(lambda: "no packet" in hands.lines(app.rates)[0], "the line that says so")

    drive(script)


@pytest.mark.long
def test_every_route_gives_a_filter_that_lets_its_packets_pass(drive):
    async def script(hands):
        app = hands.app
        await hands.press("r")
        for place, row in enumerate(app.routes._rows):
            app.routes.set_reactive(type(app.routes).cursor, place)
            where = app.filter_line.compile(app.routes.filter, None)
            passed = sum(int(where.mask(block.batch, block.columns).sum()) for block in app.store.blocks)
            assert passed >= row["count"], app.routes.filter

    drive(script)


@pytest.mark.long
def test_the_conversation_is_a_ladder_that_leads_to_packets(drive):
    async def script(hands):
        app = hands.app
        await hands.press("s")
        await hands.until(
            lambda: app.sequence.rows() > 10 and "SUB" in hands.lines(app.sequence)[0], "it is drawn"
        )
        first = hands.lines(app.sequence)[0]
        assert "●─" in first
        assert "▶" in first
        assert "66:1" in app.sequence.header().plain
        while "APP" not in hands.lines(app.sequence)[app.sequence.cursor]:
            await hands.press("j")
        await hands.press("enter")
        await hands.until(lambda: hands.number > 1)
        assert app.decoded.link is SBN
        await hands.press("escape")
        assert app._lower.current == "packet"
        await hands.press("S")
        await hands.until(lambda: any("Ground" in name for name in app.sequence._parties), "all links")

    drive(script)


def test_the_way_of_the_packet_is_followed(drive):
    async def script(hands):
        app = hands.app
        await hands.go(189)
        await hands.press("t")
        assert app._lower.current == "trace-view"
        await hands.until(lambda: len(app.trace._rows) > 1, "its way")
        await hands.until(lambda: "0x082a" in "".join(hands.lines(app.trace)[:1]), "drawn in its size")
        assert "packet 189" in "\n".join(hands.lines(app.trace))
        await hands.press("escape", "g", "t")  # SBN's own: no message of a link
        await hands.until(lambda: len(app.trace._rows) == 1 and "examined" not in app.trace.empty, "why not")
        await hands.press("escape")
        assert app._lower.current == "packet"

    drive(script)


@pytest.mark.long
def test_time_is_told_four_ways(drive):
    async def script(hands):
        seen = []
        for _ in TimeFormat:
            seen.append(hands.lines(hands.app.packets)[1].split()[1])
            await hands.press("u")
        assert seen[0] == "0.000159"
        assert seen[1] == "0.000159"
        assert seen[2].startswith("06:18:47.19")
        assert seen[3].startswith("1795241927.19")

    drive(script)


@pytest.mark.long
def test_columns_are_chosen_and_fields_become_columns(drive):
    async def script(hands):
        app = hands.app
        await hands.filter("link == sbn and msg_id == 0x082a")
        await hands.settle()
        await hands.press("c")
        assert app.prompt.input.value == "time ports packet msg_id topic bytes"
        app.prompt.input.value = "time, linear.x topic"
        await hands.press("enter")
        assert str(app.packets.header()).split() == ["No.", "Time", "Topic", "linear.x", "Message"]
        for row, line in enumerate(hands.lines(app.packets)[:5]):
            number, _, topic, value = line.split()[:4]
            datagram = app.store.datagram(row)
            assert (int(number), topic) == (datagram.number, "/robot_1/cmd_vel")
            assert float(value) == app._bench.dissector.dissect(datagram).message.values["linear"]["x"]
        await hands.press("c")
        app.prompt.input.value = "time linaer.x"
        await hands.press("enter")
        await hands.until(lambda: "did you mean linear.x" in hands.status, "the mistake")
        assert "linear.x" in str(app.packets.header()), "as before"
        await hands.press("c")
        app.prompt.input.value = ""
        await hands.press("enter")
        assert str(app.packets.header()).split()[:3] == ["No.", "Time", "Ports"]

    drive(script)


@pytest.mark.long
def test_the_selected_field_becomes_a_column(drive):
    async def script(hands):
        app = hands.app
        await hands.press("enter", "j", "j", "j")
        assert app.layers.field.label == "msg_size"
        await hands.press("c", *" length", "enter")
        assert str(app.packets.header()).split()[-2:] == ["length", "Message"]
        assert "sbn.msg_size" in str(app.packets.header())
        assert app.packets.columns[-2:] == ("sbn.msg_size", "length")

    drive(script)


@pytest.mark.long
def test_the_frame_is_shown_and_linked_too(drive):
    async def script(hands):
        app = hands.app
        await hands.press("b")
        assert app.hex_pane.title == "Frame, 109 bytes"
        assert app.layers.choose_byte(2)
        await hands.until(lambda: app.hex_pane.field == (44, 45), "the byte behind the headers")
        app.hex_pane.focus()
        app.hex_pane.action_byte(45)
        await hands.until(lambda: app.layers.field.label == "processor_id")
        app.hex_pane.action_byte(3)
        await hands.pilot.pause()
        await hands.press("b")
        assert app.hex_pane.title == "UDP payload, 67 bytes"

    drive(script)


@pytest.mark.long
def test_panes_grow_and_shrink(drive):
    async def script(hands):
        app = hands.app
        before = app.packets.size.height
        await hands.press("greater_than_sign", "greater_than_sign")
        await hands.until(lambda: app.packets.size.height > before, "more room")
        await hands.press("z")
        assert app.zoomed == "packets"
        await hands.press("escape")
        assert not app.zoomed
        await hands.press("T")
        assert app.theme == "edoras-light"

    drive(script)


@pytest.mark.long
@pytest.mark.parametrize(
    ("colours", "theme"),
    [
        ("", "dark"),
        ("15;0", "dark"),
        ("0;15", "light"),
        ("0;default;7", "light"),
        ("7;8", "dark"),
        ("x", "dark"),
    ],
)
def test_the_theme_is_that_of_the_terminal(drive, monkeypatch, colours, theme):
    monkeypatch.setenv("COLORFGBG", colours)

    async def script(hands):
        await hands.settle()
        assert hands.app.theme == f"edoras-{theme}"

    drive(script)


@pytest.mark.long
def test_help_comes_and_goes(drive):
    async def script(hands):
        await hands.press("question_mark")
        assert isinstance(hands.app.screen, Sheet)
        await hands.press("escape")
        assert not isinstance(hands.app.screen, Sheet)

    drive(script)


@pytest.mark.long
@pytest.mark.parametrize("key", ["q", "ctrl+c"])
def test_it_quits(drive, key):
    async def script(hands):
        await hands.press(key)
        await hands.until(lambda: hands.app._exit)
        assert not hands.app.return_code

    drive(script)


def test_a_signal_ends_it_cleanly(drive):
    async def script(hands):
        os.kill(os.getpid(), signal.SIGINT)
        await hands.until(lambda: hands.app._exit)

    drive(script)


@pytest.mark.long
def test_wireshark_that_is_not_there_is_one_clear_line(drive, monkeypatch):
    monkeypatch.setenv("PATH", "/nowhere")

    async def script(hands):
        await hands.press("w")
        await hands.until(lambda: "wireshark is not installed" in hands.status)
        assert "\n" not in hands.status

    drive(script)


@pytest.mark.long
def test_the_list_is_sorted_by_any_column(drive):
    async def script(hands):
        app = hands.app
        await hands.filter("pose.position.x > 0.4")
        await hands.settle()
        await hands.press("c")
        app.prompt.input.value = "time topic bytes pose.position.x"
        await hands.press("enter", "j", "j")
        chosen = hands.number
        captured = [app.store.datagram(row).number for row in range(len(app.store))]
        for column in ("time", "topic", "bytes", "pose.position.x"):
            await hands.press("o")
            await hands.until(lambda: app.store.order is not None, column)
            assert app.packets.sorted_by == column
        values = lambda: [  # noqa: E731
            app._bench.dissector.dissect(app.store.datagram(row)).message.values["pose"]["position"]["x"]
            for row in range(len(app.store))
        ]
        await hands.until(lambda: values() == sorted(values()), "rising")
        assert len(set(values())) == 9
        await hands.until(lambda: hands.number == chosen, "the cursor stays on its packet")
        await hands.press("O")
        await hands.until(lambda: values() == sorted(values(), reverse=True), "falling")
        await hands.go(captured[-1])
        assert app.store.find_number(captured[-1]) == app.packets.cursor
        await hands.press("o")
        assert [app.store.datagram(row).number for row in range(len(app.store))] == captured
        await hands.press("o", "o", "f")
        app.filter_line.input.value = ""
        await hands.press("enter")
        await hands.settle()
        app._refresh_figures()
        await hands.until(lambda: app.store.order is not None and len(app.store.order) == 1544, "all, sorted")

    drive(script)


def test_routes_of_two_rovers_filter_their_own_packets(drive, tmp_path):
    captures = {"10.0.0.2": "a_rover", "10.0.0.3": "e_ci_errors"}
    files = {address: ROOT / f"samples/captures/{name}.pcap" for address, name in captures.items()}
    whole, parts = merging.merge(files, tmp_path)

    async def script(hands):
        app = hands.app
        await hands.until(lambda: not app.reading, "the file is read")
        await hands.press("r")
        await hands.until(lambda: any("spacecraft" in row for row in app.routes._rows), "the routes")
        rows = list(app.routes._rows)
        for number, part in enumerate(parts, 1):
            own = [row["count"] for row in rows if row["spacecraft"] == number]
            assert sum(own) == len(rewriting.datagrams(part))
        place = next(at for at, row in enumerate(rows) if (row["spacecraft"], row["msg_id"]) == (2, "0x0800"))
        app.routes.cursor = place
        assert app.routes.filter == "link == to and msg_id == 0x0800 and spacecraft == 2"
        await hands.press("enter")
        await hands.settle()
        assert len(app.store) == rows[place]["count"]
        await hands.filter("spacecraft == 2")
        await hands.settle()
        assert len(app.store) == len(rewriting.datagrams(parts[1]))

    drive(script, source=open_file(whole))
