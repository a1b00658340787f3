"""Parts that turn as what they touch lets them: where the images accept several motions, a joint is what decides.

A button, a knob or a lampshade looks alike turned over, and what no view of its own state shows, or the light, may even
make it fit better so. But a joint seldom turns a part by more than a right angle against what it hangs on: that is
believed only where what fits best turns it about a line beside the object.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from splatart_ns.capture.view import View
from splatart_ns.geometry.screw import screw_from_motion
from splatart_ns.geometry.se3 import from_rotation_translation, inverse, so3_log
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.contact import Contact, find_contacts
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.motion_preference import SLIDE_TURN, TURNED_OVER
from splatart_ns.stages.render_choice import alike_in_even_light
from splatart_ns.stages.symmetric_turns import symmetric_turns

TOUCHING, NO_NEARER = 0.03, 1.5
"""Parts touch that come as near as this to each other in both states, in the normalised world, or no further than so
many times as near as any other part: what joins them may not show."""
NEAR = 0.1
"""A hinge passes by both parts no further away than this, added up, and shifts none by more."""
FAR = 1.0
"""A line that passes by further away is no hinge, however little of a motion is known: it lies beside the object."""


def turned_as_neighbours_let(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    motions: Mapping[int, InitialMotion],
) -> dict[int, InitialMotion]:
    """The parts' motions between two states: of a part that moves as no joint with what it touches does, one that looks
    alike and that a joint makes.

    Of what turns over against all that it touches, more motions are sought that look alike in even light. Those parts
    go first that rest, and those whose motions are not in doubt and make a joint with another such part; from them it
    spreads to what touches them. A wrist in the jaws of a fork fitted better turned over, as it was lit, and the fork
    was in doubt until what carries it had told how that moves.

    Args:
        splats: The labelled splats of the one and the other state.
        views: Their training views.
        motions: By part id.
    """
    motions = dict(motions)
    parts = _Parts.of(splats, [p for p, motion in motions.items() if motion.found])
    alone = {p: motions[p].T for p in parts.near if not motions[p].alike}
    upright = {p for p in alone if not parts.turns_over(p, alone)}
    rest = {p: T for p, T in alone.items() if motions[p].still}
    settled = rest.keys() | {p for p in upright if parts.jointed_to_any(p, alone)}
    waiting = parts.near.keys() - settled
    found: dict[int, tuple[InitialMotion, int]] = {}
    now = settled
    while waiting:
        for p in waiting:
            if parts.near[p] & now:
                fixed = {q: motions[q].T for q in parts.near[p] & settled}
                found[p] = _jointed(splats, views, p, motions[p], parts, fixed, rest)
        # What makes no joint with these waits for what else it touches: an arm that another carries.
        ready = {p for p, (_, made) in found.items() if p in waiting and (made or not parts.near[p] & waiting)}
        if not (now := ready or waiting & upright or waiting & found.keys()):
            break
        motions |= {p: found[p][0] for p in now & found.keys()}
        settled |= now
        waiting -= now
    return motions


def _jointed(
    splats: tuple[Splat, Splat],
    views: tuple[Sequence[View], Sequence[View]],
    part: int,
    motion: InitialMotion,
    parts: _Parts,
    fixed: Mapping[int, Tensor],
    rest: Mapping[int, Tensor],
) -> tuple[InitialMotion, int]:
    """Of a part's motion and those that look alike the first that a joint with a part makes that touches it, or rests:
    its front may touch other drawers alone. One that makes joints with several goes first: a hip moves against the body
    and the leg. The motion itself if none makes any; `fixed` and `rest` are motions [4, 4]. And how many it makes."""

    told = {**rest, **fixed}

    def joints(T: Tensor, most: float = TURNED_OVER) -> int:
        """With how much of what moves, and with what rests, which counts as one; turned by `most` at most."""
        against = {q: parts.may_be_jointed(part, q, inverse(T_q) @ T, most) for q, T_q in told.items()}
        return any(against[q] for q in rest) + sum(against[q] for q in fixed.keys() - rest.keys())

    choices = [motion.T, *motion.alike]
    if parts.turns_over(part, {**fixed, part: motion.T}):
        splat = splats[0].select(splats[0].part_ids == part)
        R, centroid = symmetric_turns(splat), splat.means.double().mean(0)
        turned = motion.T @ from_rotation_translation(R, centroid - R @ centroid)
        turned = turned[[joints(T) > 0 for T in turned]]
        choices += alike_in_even_light(splats, views, part, motion.T, turned)
    made = [joints(T) for T in choices]
    if not any(made) and all(parts.turns_afar(part, q, inverse(T_q) @ motion.T) for q, T_q in told.items()):
        made = [joints(T, math.pi) for T in choices]  # a lid may open by more than a right angle
    best = made.index(max(made))
    chosen = replace(motion, T=choices[best], alike=tuple(T for i, T in enumerate(choices) if i != best))
    return chosen, made[best]


@dataclass(frozen=True)
class _Parts:
    """Where parts are in the first of two states, and which of them touch in both."""

    contacts: Mapping[tuple[int, int], Contact]
    """Of each pair of parts, the smaller id first, in the first state."""
    near: Mapping[int, set[int]]
    """Which others touch each."""

    @classmethod
    def of(cls, splats: tuple[Splat, Splat], parts: Sequence[int]) -> _Parts:
        # Motions are in doubt, so each state's own Gaussians tell how close parts come in it.
        rest = {p: torch.eye(4).to(splats[0].means)[None] for p in parts}
        of_states = [find_contacts({p: splat.means[splat.part_ids == p] for p in parts}, rest) for splat in splats]
        gaps = {pair: max(contacts[pair].gap for contacts in of_states) for pair in of_states[0]}
        least = {p: min((gap for pair, gap in gaps.items() if p in pair), default=math.inf) for p in parts}
        near: dict[int, set[int]] = {p: set() for p in parts}
        for (p, q), gap in gaps.items():
            if gap < max(TOUCHING, NO_NEARER * least[p], NO_NEARER * least[q]):
                near[p].add(q)
                near[q].add(p)
        return cls(of_states[0], near)

    def turns_over(self, part: int, motions: Mapping[int, Tensor]) -> bool:
        """Whether a part turns over against all that it touches of the parts whose motions [4, 4] are given."""
        turns = [_turn(inverse(motions[q]) @ motions[part]) for q in self.near[part] & motions.keys()]
        return bool(turns) and min(turns) > TURNED_OVER

    def jointed_to_any(self, part: int, motions: Mapping[int, Tensor]) -> bool:
        """Whether a part may be jointed to any that it touches of the parts whose motions [4, 4] are given."""
        others = self.near[part] & motions.keys()
        return any(self.may_be_jointed(part, q, inverse(motions[q]) @ motions[part]) for q in others)

    def may_be_jointed(self, a: int, b: int, T: Tensor, most: float = TURNED_OVER) -> bool:
        """Whether T [4, 4], by which part a moves against part b, slides it or turns it about a hinge of both, by
        `most` at most."""
        turn = _turn(T)
        if turn < math.radians(SLIDE_TURN):
            return True
        apart, slide = self._hinge(a, b, T)
        return turn <= most and apart < NEAR and slide < NEAR

    def turns_afar(self, a: int, b: int, T: Tensor) -> bool:
        """Whether T [4, 4], by which part a moves against part b, turns it about a line beside the object."""
        return _turn(T) >= math.radians(SLIDE_TURN) and self._hinge(a, b, T)[0] > FAR

    def _hinge(self, a: int, b: int, T: Tensor) -> tuple[float, float]:
        """How far from both parts the line lies about which T turns part a against part b, and by how much it shifts it
        along that."""
        contact = self.contacts[min(a, b), max(a, b)]
        screw = screw_from_motion(T, contact.points.mean(0))
        return contact.distance_to_axis(screw.axis, screw.point, through_holes=False), abs(float(screw.slide))


def _turn(T: Tensor) -> float:
    return float(so3_log(T[:3, :3]).norm())
