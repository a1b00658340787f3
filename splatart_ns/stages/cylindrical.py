"""Parts that turned and slid at once, in two states: a chair's seat on its column, a cap that was screwed off.

Any motion is a turn about a line and a slide along it, so of two states a cylindrical joint explains everything and
proves nothing. Where no simpler joint explains how a part moves, that line says what the part hangs on: it runs through
the two parts, which are in touch, and by all others. With more states such joints are fitted like all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torch import Tensor

from splatart_ns.stages.contact import find_contacts
from splatart_ns.stages.joint_fit import JointFit
from splatart_ns.stages.joint_pairs import fit_pairs
from splatart_ns.stages.unseen import states_shown

_WITHIN = 0.1
"""How far apart the two parts may be, and how far the line may pass by them, as a share of the object's radius. A
chair's seat: 0.05 and 0.06 on its column, 0.49 and more on its castors."""


def turning_slides(
    points: dict[int, Tensor],
    motions: dict[int, Tensor],
    joints: Mapping[tuple[int, int], JointFit],
    hung: set[int],
    object_radius: float,
    known: Mapping[int, Tensor],
    **settings: Any,
) -> dict[tuple[int, int], JointFit]:
    """Cylindrical joints by (parent, child) of parts that are not in `hung` on those that are.

    `points` [N, 3] and `motions` [S, 4, 4] by part; `joints`: those of all pairs that may be joined, with what speaks
    against simpler ones; `known` as in `find_contacts`, `settings` as in `fit_pairs`. None between parts that more than
    two states show.
    """
    pairs = [(a, b) for a, b in joints if a in hung and b not in hung and states_shown(known, (a, b)) == 2]
    if not pairs:
        return {}
    fits = fit_pairs(points, motions, object_radius, types=["cylindrical"], **settings)
    contacts = find_contacts(points, motions, {(min(pair), max(pair)) for pair in pairs}, known)
    found = {}
    for a, b in pairs:
        fit, contact = fits[a, b], contacts[min(a, b), max(a, b)]
        apart = max(contact.gap, contact.distance_to_axis(fit.axis, fit.origin))
        if apart <= _WITHIN * object_radius:
            other = joints[a, b]
            others = [{"type": other.type, "residual": other.residual, "score": other.score}, *other.alternatives]
            note = "Two states tell of no joint that turns and slides; that the two parts touch there speaks for it."
            found[a, b] = replace(fit, ambiguous=True, alternatives=others, undetermined=[*fit.undetermined, note])
    return found
