"""Names that every robot format takes, from whatever people call their parts."""

from __future__ import annotations

import re
from collections.abc import Iterable

from splatart_ns.capture.part_names import in_ascii

RESERVED = ("world", "joints", "scene", "material", "z_up")
"""MuJoCo's name of what does not move, the neighbours of the links in a USD file, and the root's parent in a GLB."""


def identifier(name: str) -> str:
    """`name` in ASCII letters, digits and underscores, not beginning with a digit: an identifier of XML and USD."""
    cleaned = re.sub(r"[^A-Za-z0-9_]+", "_", in_ascii(name)).strip("_") or "unnamed"
    return f"_{cleaned}" if cleaned[0].isdigit() else cleaned


def identifiers(names: Iterable[str], taken: Iterable[str] = RESERVED) -> list[str]:
    """An identifier for each name, in order; one that is taken, in upper or lower case, gets a number: `lid_2`."""
    used = {name.lower() for name in taken}
    chosen = []
    for name in names:
        base = candidate = identifier(name)
        number = 2
        while candidate.lower() in used:
            candidate = f"{base}_{number}"
            number += 1
        used.add(candidate.lower())
        chosen.append(candidate)
    return chosen
