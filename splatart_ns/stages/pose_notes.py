"""Notes on what the images leave open about part poses, in the words of the pose stage's report.

Poses T are [S, P, 4, 4], covariances [S, P, 6, 6], translation first, not finite where a pose is not known; `names` are
those of the P parts. What puts a part's joint in doubt comes with a mask [P] of these parts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from splatart_ns.geometry.se3 import inverse, so3_log
from splatart_ns.stages.image_error import ImageError
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.motion_preference import OTHERWISE
from splatart_ns.stages.unseen import may_have_turned, unturned

FEW = 4
"""Of more turns that look alike a note says how many there are, and within which bounds."""
FAR, HARDLY = 10.0, 1e-3
"""Posed parts do not fit a state if they are so many times as far from its images as its own splat, which is hardly off
at the second. Of 73 states of 33 sound captures it was 5.9 times at most; 11 to 400 where labels had other ids in one
of two states."""


def unknown_poses(known: Tensor, names: Sequence[str]) -> list[str]:
    """Which poses, by `known` [S, P] bool, no image tells."""
    notes = []
    for s, p in (~known).nonzero().tolist():
        put = "it is put where another state shows it" if s == 0 else "it moves as what it hangs on"
        notes.append(f"part {names[p]}, state {s}: the images show too little of it to find its pose; {put}.")
    return notes


def open_turns(covariance: Tensor, names: Sequence[str]) -> list[str]:
    """Of which parts the covariances leave the turn open."""
    return [
        f"part {names[p]}, state {s}: the images do not tell how far it turned about its own axis."
        for s, p in may_have_turned(covariance).nonzero().tolist()
    ]


def turns_alike(
    searched: Mapping[tuple[int, int], InitialMotion],
    references: Sequence[int],
    T: Tensor,
    covariance: Tensor,
    names: Sequence[str],
) -> tuple[list[str], Tensor]:
    """By which turns other than those of T the images show a part as well.

    `searched` has the motions that the search left to choose from, by state and part, from the state that `references`
    [P] says. Of turns that the covariances leave open, `open_turns` says enough.
    """
    notes, doubted = [], torch.zeros(len(names), dtype=torch.bool)
    turn_is_open = may_have_turned(covariance)
    for (s, p), motion in searched.items():
        found = (T[s, p] @ inverse(T[references[p], p])).to(motion.T)
        # The turn that the search ended at is another one where refinement left it.
        others = [
            round(math.degrees(so3_log(X[:3, :3]).norm()))
            for X in (*motion.alike, motion.T)
            if so3_log(found[:3, :3].mT @ X[:3, :3]).norm() > OTHERWISE / 2
        ]
        if not others:
            continue
        doubted[p] = True
        if turn_is_open[s, p]:
            continue
        others = list(dict.fromkeys(others))
        few = " or ".join(map(str, others))
        by = few if len(others) <= FEW else f"{len(others)} others of {min(others)} to {max(others)}"
        turn = round(math.degrees(so3_log(found[:3, :3]).norm()))
        rests = torch.allclose(found, torch.eye(4).to(found))
        how = f"turned by {turn} degrees; by {by}"
        if not turn:
            how = f"{'rests' if rests else 'slid'}; turned by {by} degrees"
        notes.append(f"part {names[p]}, state {s}: {how} it looks nearly the same.")
    return notes, doubted


def doubtful_rest(
    maybe_moved: Tensor,
    misfits: Tensor,
    held_still: Tensor,
    begun: Tensor,
    T: Tensor,
    covariance: Tensor,
    names: Sequence[str],
) -> tuple[list[str], Tensor]:
    """Of which parts it is in doubt whether they rest.

    Of those that the search says may have moved, `maybe_moved` [S, P], and of those that do not fit where they were to
    stay, `misfits` [S, P], whose poses refinement, which began from `begun` [S, P, 4, 4], has neither turned nor, if
    they were held still [S, P], moved at all, and whose covariances leave no turn open.
    """
    turned = ~unturned(inverse(begun) @ T)
    slid = held_still.to(T.device) & ~torch.isclose(T, begun).flatten(2).all(-1)
    stayed = ~(turned | slid | may_have_turned(covariance))
    doubtful = (maybe_moved | misfits) & stayed.cpu()
    notes = []
    for s, p in doubtful.nonzero().tolist():
        but = "other motions fit its images a little better"
        if misfits[s, p]:
            but = "does not fit its images there, and no motion was found that does"
        notes.append(f"part {names[p]}, state {s}: seems to rest, but {but}.")
    return notes, doubtful.any(0)


def ill_shown(
    own: Sequence[ImageError], posed: Sequence[ImageError], states: Sequence[str], names: Sequence[str]
) -> tuple[list[str], Tensor]:
    """From which of the `states`' images the posed parts are much further than the state's own splat was.

    All parts are in doubt then: labels may have other ids there, and what rests may have moved instead.
    """
    notes = []
    for state, before, now in zip(states, own, posed, strict=True):
        times = now.of_object / max(before.of_object, HARDLY)
        if times > FAR:
            part = names[int((now.by_part - before.by_part)[1:].argmax())]
            notes.append(
                f"{state}: the posed parts differ from its images {times:.0f} times as much as its own Gaussians do, "
                f"most at part {part}: poses are wrong, or parts bend, or have other ids in another state; see "
                "`splatart check`."
            )
    return notes, torch.full((len(names),), bool(notes))
