"""Draws the pictures of the pages from the sample captures, as the commands show them.

    python docs/make_pictures.py

``tests/docs`` draws them again and compares what they say.
"""  # noqa: INP001  a script beside the pages, no package

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

from edoras_tools.pipelines.info import inspect
from edoras_tools.pipelines.sniff import find
from edoras_tools.pipelines.workbench import Settings, open_files
from edoras_tools.render import packet, palette
from edoras_tools.render.info import capture_summary
from edoras_tools.render.packet_list import PacketList
from edoras_tools.render.svg import picture

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

SAMPLES: Final = Path(__file__).resolve().parents[1] / "samples"
FOLDER: Final = Path(__file__).parent / "pictures"
_ROVERS: Final = ("two_rovers_ground", "two_rovers_flight")
_CONFIGS: Final = " ".join(f"-c {name}.yaml" for name in _ROVERS)
_SHOWN: Final = (range(186, 196), range(1196, 1205), range(1345, 1351))
"""A link at work; a SUB that SBN refuses; a cut message that the app passes on."""


def _bench(capture: str, missions: Sequence[str]) -> tuple[Settings, Path]:
    configs = tuple(SAMPLES / f"missions/{name}.yaml" for name in missions)
    return Settings(configs), SAMPLES / f"captures/{capture}.pcap"


def sniff() -> str:
    """Draw the packet list."""
    settings, path = _bench("f_sbn_disconnect", _ROVERS)
    bench, source = settings.workbench(), open_files([path])
    view = PacketList(128, colour=True)
    lines = [view.header()]
    for batch in source.batches():
        for row in range(len(batch)):
            decoded = bench.dissector.dissect(batch[row])
            number, line = decoded.datagram.number, view.line(decoded)
            if any(number in part for part in _SHOWN):
                if lines[1:] and number in {part.start for part in _SHOWN}:
                    lines.append(palette.Paint(colour=True)("     ⋮", palette.DIM))
                lines.append(line)
    source.close()
    return picture(lines, width=128, title=f"edoras sniff -r f_sbn_disconnect.pcap {_CONFIGS}")


def decode() -> str:
    """Draw one packet, its tree and its bytes."""
    settings, path = _bench("f_sbn_disconnect", _ROVERS)
    decoded = find(open_files([path]), settings.workbench(), 189)
    lines = packet.lines(decoded, 150, colour=True, chosen="ros.linear.x")
    title = f"edoras decode f_sbn_disconnect.pcap 189 {_CONFIGS} --layer ros.linear.x"
    return picture(lines, width=150, title=title)


def info() -> str:
    """Draw what is in a capture."""
    settings, path = _bench("a_rover", ["rover_ground"])
    summary = inspect(open_files([path]), settings.workbench()).summary()
    view = capture_summary({**summary, "source": path.name})
    return picture([view], width=100, title="edoras info a_rover.pcap -c rover_ground.yaml")


PICTURES: Final[dict[str, Callable[[], str]]] = {"sniff": sniff, "decode": decode, "info": info}
"""What draws each ``pictures/NAME.svg``."""


def main() -> None:
    """Draw all of them."""
    FOLDER.mkdir(exist_ok=True)
    for name, draw in PICTURES.items():
        (FOLDER / f"{name}.svg").write_text(draw(), encoding="utf-8")


if __name__ == "__main__":
    main()
