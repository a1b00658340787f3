"""What JSON must be like to be used: notes in an output folder may be damaged, or somebody else's."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

NUMBER = float
"""Shape of a finite number."""


def parse(data: bytes | None, shape: Any) -> Any | None:
    """The JSON in `data` if it is of a shape, see `has_shape`; None for anything else."""
    try:
        value = None if data is None else json.loads(data)
    except (ValueError, RecursionError):
        return None
    return value if has_shape(value, shape) else None


def with_keys_once(refuse: Callable[[str], Exception]) -> Callable[[Sequence[tuple[str, Any]]], dict[str, Any]]:
    """An `object_pairs_hook` that raises what `refuse` makes of a key that an object has twice, of which `json` would
    take the last without a word."""

    def unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
        times = Counter(key for key, _ in pairs)
        for key, count in times.items():
            if count > 1:
                raise refuse(key)
        return dict(pairs)

    return unique


def has_shape(value: Any, shape: Any) -> bool:
    """Whether a JSON value is as a shape says.

    A type means its values, `NUMBER` finite ones; `[shape]` lists of these; `{key: shape}` objects with these keys, and
    maybe others; `(shape, ...)` one of several; None null.
    """
    if shape is None:
        return value is None
    if shape is NUMBER:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    if isinstance(shape, tuple):
        return any(has_shape(value, one) for one in shape)
    if isinstance(shape, list):
        return isinstance(value, list) and all(has_shape(item, shape[0]) for item in value)
    if isinstance(shape, dict):
        return isinstance(value, dict) and all(k in value and has_shape(value[k], s) for k, s in shape.items())
    return isinstance(value, shape) and (shape is bool or not isinstance(value, bool))
