"""Names in C, and places that do not follow from the types of a sheet alone; ``test_types`` has the rest."""

import pytest

from edoras_tools.addons.databases.documents import SheetError
from edoras_tools.addons.databases.placement import DataType, Placement, c_name, polynomial
from edoras_tools.structs.shapes import BASIC, OPEN

WORD = DataType(BASIC["uint32"], 32, scalar=True, order="big", alignment=4)


@pytest.mark.parametrize(
    ("name", "own"),
    [
        ("CFE_ES/HousekeepingTlm", "CFE_ES_HousekeepingTlm"),
        ("char@10", "char_10"),
        ("3D", "_3D"),
        ("", "unnamed"),
        ("\u00e9", "_"),
    ],
)
def test_a_name_in_c(name, own):
    assert c_name(name) == own


@pytest.mark.parametrize(("machine", "places", "size"), [(False, [0, 5], 72), (True, [0, 8], 96)])
def test_padding_and_the_end(machine, places, size):
    placement = Placement("big", machine=machine)
    assert placement.place("a", WORD) == ""
    placement.pad(8)
    assert placement.place("a", WORD) == ""
    assert [(item.name, item.offset) for item in placement.members] == [("a", places[0]), ("a2", places[1])]
    assert placement.end() == size
    assert placement.wrapped is None


def test_a_calibration_has_a_coefficient_for_each_power():
    assert polynomial({2.0: 0.5, 0: -40.0}) == (-40.0, 0.0, 0.5)
    assert polynomial({}) == ()


@pytest.mark.parametrize("power", [-1, 1.5, 65])
def test_a_power_that_no_calibration_has(power):
    with pytest.raises(SheetError, match=f"exponent {power} of a calibration is not 0 to 64"):
        polynomial({0: 1.0, power: 2.0})


def test_what_wraps_one_number():
    placement = Placement("big", machine=False)
    placement.place("Value", WORD)
    assert placement.wrapped is WORD


def test_more_than_any_packet():
    placement = Placement("big", machine=False)
    placement.pad(1 << 28)
    with pytest.raises(SheetError, match="its 33,554,432 bytes are more than any packet holds"):
        placement.end()


def test_the_rest_is_the_last():
    placement = Placement("little", machine=False)
    placement.pad(3)
    assert placement.open("list", WORD).startswith("its elements are not alike")
    assert (placement.members[-1].offset, placement.members[-1].dims, placement.varies) == (1, (OPEN,), True)
