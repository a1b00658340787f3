"""What the user knows of joints: which there are, which there are not, and of which type."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from splatart_ns.errors import InputError
from splatart_ns.stages.arborescence import find_cycle
from splatart_ns.stages.joint_parameters import JOINT_DOFS


@dataclass(frozen=True)
class JointConstraint:
    """What the user says about the joint between two parts, given by their ids."""

    parent: int
    child: int
    type: str | None = None
    """A key of `JOINT_DOFS`; None for any."""
    forbidden: bool = False
    """There is no such joint, either way round; with a type, none of this type. Otherwise the joint is in the tree."""


def parse_constraints(
    words: Sequence[str], part_names: Mapping[int, str], root: int | None = None
) -> list[JointConstraint]:
    """Constraints from texts: `child:parent=revolute`, `child:parent` (of any type), `child:parent=none` (no joint),
    `child:parent=not-revolute` (none of that type).

    Raises:
        InputError: a text of another form, a name that no part has, a type that there is not, contradictions.
    """
    ids = {name: part for part, name in part_names.items()}
    constraints = []
    for word in words:
        pair, equals, kind = (text.strip() for text in word.partition("="))
        child, colon, parent = (text.strip() for text in pair.partition(":"))
        if not colon:
            raise InputError(
                f"--joint: '{word}' has no ':'; write child:parent=type, child:parent or child:parent=none"
            )
        for name in (child, parent):
            if name not in ids:
                raise InputError(f"--joint: no part is called '{name}'; there are {', '.join(ids)}")
        forbidden = kind == "none" or kind.startswith("not-")
        named = kind.removeprefix("not-")
        if equals and kind != "none" and named not in JOINT_DOFS:
            raise InputError(f"--joint: '{word}' names no type; there are {', '.join(JOINT_DOFS)} and none")
        constraints.append(JointConstraint(ids[parent], ids[child], named if named in JOINT_DOFS else None, forbidden))
    required_parents(constraints, root, part_names)
    return constraints


def required_parents(
    constraints: Sequence[JointConstraint], root: int | None, part_names: Mapping[int, str]
) -> dict[int, int]:
    """The required parent by child. Raises InputError where no tree can be as the constraints say."""

    def shown(c: JointConstraint) -> str:
        return f"{part_names[c.child]}:{part_names[c.parent]}"

    required: dict[int, JointConstraint] = {}
    for c in constraints:
        if c.parent == c.child:
            raise InputError(f"--joint: '{shown(c)}' joins a part with itself; name two parts")
        if c.forbidden:
            continue
        if c.child == root:
            raise InputError(
                f"--joint: '{shown(c)}' hangs the root on another part; choose another root or turn it round"
            )
        other = required.setdefault(c.child, c)
        if other.parent != c.parent:
            raise InputError(f"--joint: '{shown(other)}' and '{shown(c)}' give one part two parents; keep one of them")
        if other.type != c.type:
            raise InputError(f"--joint: '{shown(c)}' is given two types; keep one of them")
    for c in constraints:
        wanted = next((r for r in required.values() if {c.parent, c.child} == {r.parent, r.child}), None)
        if c.forbidden and wanted is not None and c.type in (None, wanted.type):
            raise InputError(f"--joint: '{shown(c)}' is both required and forbidden; keep one of them")
    parents = {child: c.parent for child, c in required.items()}
    if cycle := find_cycle(parents):
        around = " and ".join(f"'{shown(required[p])}'" for p in sorted(cycle))
        raise InputError(f"--joint: {around} go round in a circle; leave one out")
    return parents
