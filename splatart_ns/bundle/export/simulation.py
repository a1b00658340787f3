"""An exported MJCF run in MuJoCo."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SECONDS = 10.0
"""The least simulated time."""
_SECONDS_A_JOINT = 2.0
_FASTEST = 100.0  # radian or metre per second: beyond, something exploded


@dataclass(frozen=True)
class Run:
    """What happened while every joint was driven across its range in turn, under gravity."""

    seconds: float
    """Simulated."""
    stable: bool
    """No value that is not finite, no warning of MuJoCo, no speed of an explosion."""
    excess: float
    """The most that a joint went beyond its limits, as a share of its range."""
    strayed: float
    """The most that a joint that follows another was from where that one puts it, radian or metre."""
    reached: float
    """The least share of its range that a joint covered while it was driven."""
    slowest: str
    """That joint; empty if there is none."""
    at_rest: frozenset[tuple[str, str]]
    """Pairs of bodies in contact in the first state."""
    touched: frozenset[tuple[str, str]]
    """Pairs of bodies in contact at any time."""


def simulate(path: Path) -> Run:
    """Drive the file's own actuators, one after the other, to the upper limit, to the lower, and back.

    The others hold their joints at 0, but for those around a loop with the one that is driven: they let go.
    """
    import mujoco

    told = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)  # else it writes a log file where the user stands; `data` counts them
    try:
        return _driven(mujoco.MjModel.from_xml_path(str(path)))
    finally:
        mujoco.set_mju_user_warning(told)


def _driven(model) -> Run:
    import mujoco

    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    at_rest = touched = _contacts(model, data)
    seconds = max(SECONDS, _SECONDS_A_JOINT * model.nu)
    steps = round(seconds / model.opt.timestep)
    limited = np.flatnonzero(model.jnt_limited)
    low, high = model.jnt_range[limited].T
    driven_low, driven_high = np.full(model.nu, np.inf), np.full(model.nu, -np.inf)
    followings = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
    followers, leaders = model.eq_obj1id[followings], model.eq_obj2id[followings]
    factors = model.eq_data[followings, 1]
    places = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    lets_go = _around_loops(model)
    gains, biases = model.actuator_gainprm.copy(), model.actuator_biasprm.copy()
    stable, excess, strayed = True, 0.0, 0.0
    for step in range(steps):
        data.ctrl[:] = 0.0
        turn, phase = divmod(step * model.nu / steps, 1.0) if model.nu else (0, 0.0)
        actuator = int(turn)
        if model.nu:
            holds = ~lets_go[actuator][:, None]
            model.actuator_gainprm[:], model.actuator_biasprm[:] = holds * gains, holds * biases
            data.ctrl[actuator] = _across(phase, *model.actuator_ctrlrange[actuator])
        mujoco.mj_step(model, data)
        stable &= bool(np.isfinite(data.qpos).all() and np.isfinite(data.qacc).all())
        stable &= bool(np.abs(data.qvel).max(initial=0.0) < _FASTEST)
        if not stable:
            break
        if data.ncon:
            touched |= _contacts(model, data)
        q = data.qpos[limited]  # all joints are of one number
        beyond = np.maximum(q - high, low - q) / (high - low)
        if model.nu:  # what let go hangs at its limits
            beyond[np.isin(limited, model.actuator_trnid[lets_go[actuator], 0])] = 0.0
        excess = max(excess, float(beyond.max(initial=0.0)))
        strayed = max(strayed, float(np.abs(data.qpos[followers] - factors * data.qpos[leaders]).max(initial=0.0)))
        if model.nu:
            q = data.qpos[places[actuator]]
            driven_low[actuator] = min(driven_low[actuator], q)
            driven_high[actuator] = max(driven_high[actuator], q)
    stable &= not any(warning.number for warning in data.warning)
    covered = (driven_high - driven_low) / np.ptp(model.jnt_range[model.actuator_trnid[:, 0]], axis=1)
    slowest = model.actuator(int(covered.argmin())).name if model.nu else ""
    return Run(seconds, stable, excess, strayed, float(covered.min(initial=1.0)), slowest, at_rest, touched)


def _around_loops(model) -> np.ndarray:
    """By actuator, which others [nu, nu] bool move joints of a loop that its own joint belongs to."""
    import mujoco

    def to_world(body: int) -> set[int]:
        path = set()
        while body:
            path.add(body)
            body = int(model.body_parentid[body])
        return path

    moved = model.jnt_bodyid[model.actuator_trnid[:, 0]]
    together = np.zeros((model.nu, model.nu), dtype=bool)
    closures = np.isin(model.eq_type, [mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD])
    for a, b in zip(model.eq_obj1id[closures], model.eq_obj2id[closures], strict=True):
        inside = np.isin(moved, list(to_world(int(a)) ^ to_world(int(b))))
        together |= inside[:, None] & inside
    return together & ~np.eye(model.nu, dtype=bool)


def _across(phase: float, low: float, high: float) -> float:
    """From 0 to the upper limit, to the lower one and back, like a cosine, as the phase goes from 0 to 1."""
    start = math.acos(min(max((high + low) / (high - low), -1.0), 1.0))
    return low + (high - low) * (1 - math.cos(start + 2 * math.pi * phase)) / 2


def _contacts(model, data) -> frozenset[tuple[str, str]]:
    bodies = (sorted(model.body(model.geom_bodyid[geom]).name for geom in contact.geom) for contact in data.contact)
    return frozenset((a, b) for a, b in bodies)
