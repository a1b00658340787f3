"""Part motions that a user brings, to start the search for poses from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from splatart_ns.records import read_record


def read_motions(path: Path, part_names: Sequence[str], num_states: int) -> Tensor:
    """Motions [S, P, 4, 4] float64, state 0 to each state, in the capture's unit, parts in the order of `part_names`.

    The file is a bundle's articulation.json, or any JSON with its `"parts": [{"name", "motion"}]`.

    Raises:
        InputError: a file that cannot be read, a part that is missing, matrices that are not rigid.
    """
    top = read_record(path, "give a JSON file with the parts' motions, for example a bundle's articulation.json")
    motions = {}
    for record in top.records("parts"):
        name = record.choice("name", list(part_names))
        motions[name] = record.motions("motion", record.items("motion"), num_states)
        if not torch.allclose(motions[name][0], torch.eye(4).to(motions[name]), atol=1e-5):
            record.fail("motion", "does not begin with the identity", "count motions from state 0")
        motions[name][0] = torch.eye(4)
    if missing := [name for name in part_names if name not in motions]:
        top.fail("parts", f"lacks {', '.join(missing)}", "give a motion for every part of the capture")
    return torch.stack([motions[name] for name in part_names], dim=1)
