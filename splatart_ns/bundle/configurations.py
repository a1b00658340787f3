"""Joint values for rendering: what a person types or saved, sweeps over the joints' ranges, trajectories in files."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from splatart_ns.bundle.bundle import JOINT_DOFS, JOINT_LENGTHS, Bundle, Joint
from splatart_ns.errors import InputError
from splatart_ns.records import LONGEST, read_record

Configuration = dict[str, float | list[float]]
"""Joint name to value, radian or length, or to as many as the joint has freedoms (`Joint.values`); joints that are not
named are at 0, where state 0 has them. A joint may be called by the part that it moves (`Bundle.tree_joint`)."""


def movable_joints(bundle: Bundle) -> dict[str, Joint]:
    """The tree's joints with a freedom, by name, parents before children."""
    return {joint.name: joint for joint in bundle.tree_joints if JOINT_DOFS[joint.type] > 0}


def parse_settings(settings: Sequence[str], bundle: Bundle) -> Configuration:
    """A configuration from texts `joint=value` or `part=value`; see `parse_value`. Values beyond limits are taken."""
    configuration: Configuration = {}
    for setting in settings:
        name, equals, text = setting.rpartition("=")
        if not equals:
            raise InputError(f"--set: '{setting}' has no '='; write joint=value, for example door=30deg")
        joint = _find(name.strip(), bundle, "--set")
        if joint.name in configuration:
            raise InputError(f"--set: joint '{joint.name}' is set twice; set it once")
        configuration[joint.name] = parse_value(text, joint, "--set")
    return configuration


def parse_value(text: str, joint: Joint, where: str) -> float | list[float]:
    """A joint's value: a plain number in the bundle's unit (radian or length), or with the suffix `deg` an angle.

    Joints of several freedoms take as many, with commas between: lengths first, then angles.
    """
    dofs, lengths = JOINT_DOFS[joint.type], JOINT_LENGTHS.get(joint.type, 0)
    numbers = text.split(",")
    if len(numbers) != dofs:
        raise InputError(
            f"{where}: '{text.strip()}' is {len(numbers)} numbers but joint '{joint.name}' is {joint.type}; give {dofs}"
        )
    values = [_parse_number(n.strip(), joint, i < lengths, where) for i, n in enumerate(numbers)]
    return values[0] if dofs == 1 else values


def _parse_number(number: str, joint: Joint, is_length: bool, where: str) -> float:
    degrees = number.lower().endswith("deg")
    if degrees and is_length:
        raise InputError(f"{where}: '{number}' is an angle but joint '{joint.name}' slides; give a length")
    try:
        value = float(number[:-3] if degrees else number)
    except ValueError:
        value = math.nan
    if not abs(value) < LONGEST:
        raise InputError(f"{where}: '{number}' for joint '{joint.name}' is no number; write 0.5 or 30deg")
    return math.radians(value) if degrees else value


def read_configuration(path: Path, bundle: Bundle) -> Configuration:
    """A configuration from a JSON file `{joint: value, or [values]}`, radians and lengths, as the viewer saves it."""
    record = read_record(Path(path), "give a JSON file of joint names and values, as `splatart view` saves it")
    configuration: Configuration = {}
    for name, value in record.fields.items():
        joint = _find(name, bundle, f"{path}")
        if joint.name in configuration:
            raise InputError(f"{path}: joint '{joint.name}' is given twice; give it once")
        dofs = JOINT_DOFS[joint.type]
        configuration[joint.name] = record.numbers(name, value, (dofs,) if dofs > 1 else ()).tolist()
    return configuration


def sweep(bundle: Bundle, base: Mapping[str, float | list[float]], frames_per_joint: int) -> list[Configuration]:
    """One movable joint after the other over its range, there and back, the others as in `base`.

    A joint of one freedom moves over its range like a cosine; it begins and ends at its value in `base` (0 where it has
    none), or at the end of its range next to that. One of several goes through its values at the states in turn, and
    back.
    """
    configurations = []
    for name, joint in movable_joints(bundle).items():
        values = _sweep_values(joint, base.get(name, 0.0), frames_per_joint)
        configurations += [{**base, name: value} for value in values]
    return configurations or [dict(base)]


def _sweep_values(joint: Joint, start: float | list[float], frames: int) -> list[float] | list[list[float]]:
    """None for a joint that did not move."""
    if JOINT_DOFS[joint.type] > 1:
        if not joint.values.any():
            return []
        states = np.arange(len(joint.values))
        at = len(states[1:]) * (1 - np.cos(2 * np.pi * np.arange(frames) / frames)) / 2
        return np.stack([np.interp(at, states, column) for column in joint.values.numpy().T], axis=1).tolist()
    ((low, high),) = joint.ranges
    if low == high:
        return []
    start = min(max(start, low), high)
    angles = math.acos(1 - 2 * (start - low) / (high - low)) + 2 * np.pi * np.arange(frames) / frames
    return (low + (high - low) * (1 - np.cos(angles)) / 2).tolist()


def read_trajectory(path: Path, bundle: Bundle) -> list[Configuration]:
    """Configurations from a CSV file: a header of joint names, then a row of values (see `parse_value`) per frame.

    With commas between, or semicolons where the header has no comma.
    """
    try:
        if Path(path).exists() and not Path(path).is_file():  # a pipe would never end
            raise InputError(f"{path}: is not a file; give a CSV file")
        text = Path(path).read_text(encoding="utf-8-sig")
        header = text.lstrip().partition("\n")[0]
        delimiter = ";" if ";" in header and "," not in header else ","
        lines = csv.reader(io.StringIO(text), delimiter=delimiter)
        rows = [(i, row) for i, row in enumerate(lines, start=1) if any(cell.strip() for cell in row)]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is no CSV text ({error}); save it as UTF-8") from error
    if len(rows) < 2:
        raise InputError(f"{path}: has {len(rows)} lines; give a header of joint names and a row of values per frame")
    no_times = "; remove other columns, also of times: a row is a frame"
    joints = [_find(cell.strip(), bundle, f"{path}", no_times) for cell in rows[0][1]]
    names = [joint.name for joint in joints]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: the header names a joint twice; name each once")
    configurations = []
    for line, row in rows[1:]:
        if len(row) != len(names):
            raise InputError(f"{path}: line {line} has {len(row)} values; the header names {len(names)} joints")
        values = [parse_value(cell, joint, f"{path}, line {line}") for cell, joint in zip(row, joints, strict=True)]
        configurations.append(dict(zip(names, values, strict=True)))
    return configurations


def _find(name: str, bundle: Bundle, where: str, mend: str = "") -> Joint:
    """The movable joint of this name, or that moves the part of this name."""
    joint = bundle.tree_joint(name)
    if joint is None or JOINT_DOFS[joint.type] == 0:
        known = ", ".join(movable_joints(bundle)) or "none"
        raise InputError(f"{where}: no movable joint is called '{name}'; there are {known}{mend}")
    return joint
