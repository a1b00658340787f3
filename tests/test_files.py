import json
import math

import pytest

from splatart_ns.files import replacing, write_json


def test_a_block_that_ends_well_puts_the_file_in_place(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with replacing(path) as temporary:
        assert temporary.parent == path.parent and temporary.suffix == ".txt"
        temporary.write_text("whole")
        assert not path.exists()
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_a_block_that_fails_leaves_the_last_good_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("good")
    with pytest.raises(RuntimeError), replacing(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "good"
    assert list(tmp_path.iterdir()) == [path]


def test_what_is_not_finite_becomes_null(tmp_path):
    write_json(tmp_path / "a.json", {"a": [1, (math.nan, 2.5)], "b": {"c": -math.inf}, "d": True, "e": "NaN"})
    value = json.loads((tmp_path / "a.json").read_text())
    assert value == {"a": [1, [None, 2.5]], "b": {"c": None}, "d": True, "e": "NaN"}
