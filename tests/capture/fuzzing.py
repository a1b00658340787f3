"""Damaged files for the fuzz tests. `make fuzz` sets how many are tried of each; the test-suite tries a few."""

from __future__ import annotations

import copy
import json
import os
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from splatart_ns.errors import InputError

EXAMPLES = int(os.environ.get("SPLATART_FUZZ_EXAMPLES", "30"))


def fuzzed(test, one_in: int = 1):
    """Settings of a fuzz test: the same examples each time, and of a slow one only some, unless many are asked for."""
    many = EXAMPLES >= 1000
    examples = EXAMPLES if many else max(1, EXAMPLES // one_in)
    unchecked = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large]
    quiet = {"deadline": None, "suppress_health_check": unchecked}
    return settings(max_examples=examples, derandomize=not many, **quiet)(test)


STRANGE = [
    *(None, True, -1, 0, 1, 2.5, 1e300, -1e308, 10**400, float("nan"), float("inf"), 65535, 2**31, 2**63, 2**64),
    *("", "x", "\0", "\udcff", "\ud800", "/", "..", "../../secret.png", "/etc/passwd", "a" * 5000, "\n", "0"),
    *([], [[]], {}, [None], {"a": 1}, [0] * 100, [[0.0] * 4] * 4, [1e300] * 6),
]


@st.composite
def damaged_bytes(draw: st.DrawFn, data: bytes) -> bytes:
    """A file with bytes changed, taken out, repeated, or its end cut off."""
    out = bytearray(data)
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, max(0, len(out) - 1)))
        kind = draw(st.sampled_from(["bit", "bytes", "cut out", "repeat", "grow"]))
        if kind == "bit" and out:
            out[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "bytes":
            new = draw(st.sampled_from([b"\xff\xff\xff\xff", b"\0\0\0\0", b"\x7f\xff\xff\xff", b"\x80", b"9999999999"]))
            out[at : at + len(new)] = new
        elif kind == "cut out":
            del out[at : at + draw(st.integers(1, 64))]
        elif kind == "repeat":
            out[at:at] = out[at : at + draw(st.integers(1, 64))]
        else:
            out[at:at] = draw(st.binary(max_size=16))
    if draw(st.booleans()):
        out = out[: draw(st.integers(0, len(out)))]
    return bytes(out)


@st.composite
def damaged_json(draw: st.DrawFn, value: Any) -> bytes:
    """A JSON file with values replaced, taken out or said again elsewhere; now and then no JSON any more."""
    value = copy.deepcopy(value)
    for _ in range(draw(st.integers(1, 3))):
        parent, place = None, value
        while isinstance(place, dict | list) and place and draw(st.integers(0, 4)) > 0:
            keys = sorted(place) if isinstance(place, dict) else range(len(place))
            parent, key = place, draw(st.sampled_from(keys))
            place = place[key]
        if parent is None:
            continue
        change = draw(st.sampled_from(["strange", "strange", "strange", "away", "twice"]))
        if change == "strange":
            parent[key] = copy.deepcopy(draw(st.sampled_from(STRANGE)))
        elif change == "away":
            del parent[key]
        elif isinstance(parent, list):
            parent.append(place)
    data = json.dumps(value).encode()
    return draw(damaged_bytes(data)) if draw(st.integers(0, 9)) == 0 else data


def one_sentence(function, *arguments) -> Any:
    """The result, or None where the input was refused by an `InputError` of one line with its mend."""
    try:
        return function(*arguments)
    except InputError as error:
        message = str(error)
        assert message.isprintable() and ";" in message, message
        return None
