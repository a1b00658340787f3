"""A page that was written, read again: its Gaussians, and its joints by other formulae than the page's."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import expm

from splatart_ns.bundle.export.quantization import restored


class PageModel:
    """What the page knows of the object. Raises ValueError or KeyError for a file that is no such page."""

    def __init__(self, path: Path):
        found = _ObjectFinder()
        found.feed(path.read_text(encoding="utf-8"))
        found.close()
        self.object: dict[str, Any] = json.loads("".join(found.texts))

    @property
    def part_names(self) -> list[str]:
        return [part["name"] for part in self.object["parts"]]

    @property
    def radius(self) -> float:
        """Of the object, length."""
        return self.object["view"]["radius"]

    def column(self, part: int, name: str) -> np.ndarray:
        """Values [N, K] of a part's Gaussians, as packed."""
        return restored(self.object["parts"][part]["columns"][name])

    def motions(self, q: Mapping[str, float | Sequence[float]]) -> dict[str, np.ndarray]:
        """T[part] [4, 4], canonical frame to the configuration `q`; every joint moves by the exponential of a twist."""
        names = self.part_names
        motions = {name: np.eye(4) for name in names}
        for joint in self.object["joints"]:
            if joint["in_tree"]:
                value = np.ravel(q.get(joint["name"], np.zeros(len(joint["freedoms"]))))
                child, parent = names[joint["child"]], names[joint["parent"]]
                motions[child] = motions[parent] @ expm(_twist(joint, value))
        return motions


class _ObjectFinder(HTMLParser):
    """Collects the text of the script element whose id is "object"."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._inside = tag == "script" and ("id", "object") in attrs

    def handle_endtag(self, tag: str) -> None:
        self._inside = False

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.texts.append(data)


def _twist(joint: Mapping[str, Any], value: np.ndarray) -> np.ndarray:
    """The matrix [4, 4] whose exponential is the joint's motion."""
    axis, origin = np.array(joint["axis"]), np.array(joint["origin"])
    turn, shift = np.zeros(3), np.zeros(3)
    match joint["type"]:
        case "revolute":
            turn = value[0] * axis
        case "prismatic":
            shift = value[0] * axis
        case "screw":
            turn, shift = value[0] * axis, value[0] * joint["pitch"] * axis
        case "cylindrical":
            shift, turn = value[0] * axis, value[1] * axis
        case "spherical":
            turn = value
        case "free":
            shift, turn = value[:3] + np.cross(value[3:], origin), value[3:]
        case "fixed":
            pass
        case kind:
            raise ValueError(f"a joint of unknown type '{kind}'")
    x, y, z = turn
    twist = np.zeros((4, 4))
    twist[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    twist[:3, 3] = shift - np.cross(turn, origin)
    return twist
