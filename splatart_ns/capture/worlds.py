"""States that were captured separately, each in a world of its own, put into one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from splatart_ns.capture.capture import REACH, Capture, State
from splatart_ns.choices import Worlds
from splatart_ns.errors import InputError

APART, UNLIKE = 1.0, 3.0
"""States of one world hardly ever have cameras that look so far apart, in half widths of what they see there, or see so
many times as much. (Of 196 pairs of states they looked within 0.01, and saw 1.002 times as much at most.)"""
OTHER_WORLDS_MEND = "fit it with --worlds similar (rigid if lengths are measured)"


def in_one_world(capture: Capture, T: np.ndarray | Sequence[Sequence[Sequence[float]]]) -> Capture:
    """The capture with the similarities T [S, 4, 4] applied to its states: state k's world to that of state 0.

    It keeps the normalisation of state 0 alone.
    """
    states = tuple(_placed(state, Tk) for state, Tk in zip(capture.states, np.asarray(T, dtype=float), strict=True))
    return replace(capture, states=states, normalization=states[0].normalization())


def focus_on_focus(capture: Capture, worlds: Worlds) -> Capture:
    """The capture, whose worlds differ so, with its states side by side: where the cameras of each look is one place.

    For "similar" they look from as far, too. How states are turned to each other, only their images tell.
    """
    if worlds == "shared":
        return replace(capture, worlds=worlds)
    own = [state.normalization() for state in capture.states]
    T = np.tile(np.eye(4), (len(own), 1, 1))
    for Tk, normalization in zip(T, own, strict=True):
        scale = normalization.scale / own[0].scale if worlds == "similar" else 1.0
        Tk[:3, :3] *= scale
        Tk[:3, 3] = own[0].centre - scale * normalization.centre
    T[0] = np.eye(4)
    return replace(in_one_world(capture, T), worlds=worlds)


def looks_elsewhere(capture: Capture, state: State) -> str | None:
    """What is strange about where a state's cameras look, if it is said to share the world of the first; else None."""
    if capture.worlds != "shared":
        return None
    first, own = capture.states[0].normalization(), state.normalization()
    apart = np.linalg.norm(own.centre - first.centre) * min(own.scale, first.scale)
    times = max(own.scale / first.scale, first.scale / own.scale)
    if apart < APART and times < UNLIKE:
        return None
    return f"its cameras do not look where those of {capture.states[0].name} do: the states may have different worlds"


def require_one_place(capture: Capture) -> None:
    """Raises `InputError` where states said to share a world look so far apart that no fit finds the object in both."""
    shared = capture.normalization
    out = [np.abs(shared.scale * (s.normalization().centre - shared.centre)).max() > REACH for s in capture.states]
    for state, is_out in zip(capture.states[1:], out[1:], strict=True):
        if (is_out or out[0]) and (strange := looks_elsewhere(capture, state)) is not None:
            mend = f"{OTHER_WORLDS_MEND}, or with --worlds shared to try it as one"
            raise InputError(f"{capture.path / state.name}: {strange}; {mend}.")


def _placed(state: State, T: np.ndarray) -> State:
    scale = np.cbrt(np.linalg.det(T[:3, :3]))
    frames = []
    for frame in state.frames:
        pose = T @ frame.T_world_camera
        pose[:3, :3] /= scale
        frames.append(replace(frame, T_world_camera=pose, depth_unit=scale * frame.depth_unit))
    return replace(state, frames=tuple(frames), placement=T @ state.placement)
