import re

import pytest

from splatart_ns.bundle.export.names import identifier, identifiers


@pytest.mark.parametrize(
    ("name", "clean"),
    [
        ("lid", "lid"),
        ("left door/handle", "left_door_handle"),
        ("Tür", "Tur"),
        ("2nd drawer", "_2nd_drawer"),
        ("柜门", "unnamed"),
        ("", "unnamed"),
        ("<a & 'b'>", "a_b"),
        ("__x__", "x"),
    ],
)
def test_any_name_becomes_an_identifier(name, clean):
    assert identifier(name) == clean
    assert re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", clean)


def test_names_that_become_the_same_are_numbered_in_order():
    assert identifiers(["a b", "a/b", "A-B", "a_b_2"]) == ["a_b", "a_b_2", "A_B_3", "a_b_2_2"]


def test_names_that_formats_keep_for_themselves_are_not_given():
    assert identifiers(["world", "Joints", "z up"]) == ["world_2", "Joints_2", "z_up_2"]
