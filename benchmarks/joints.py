"""Joints and trees from motions of known truth and stated noise: hard cases, honesty, and time.

Usage:
    python benchmarks/joints.py [--seeds 200]

Seconds are CPU time of one thread. The cases are those of tests/stages/joint_cases.py.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "stages"))
from joint_cases import HARD_CASES, TREE_CASES, JointErrors, fit_cases, joint_errors, random_case, random_object

from splatart_ns.evaluation.joints import axis_angle
from splatart_ns.stages.joint import types_for
from splatart_ns.stages.joint_pairs import descend_pairs, fit_pairs
from splatart_ns.stages.tree import infer_tree, object_radius

CONSOLE = Console(width=170)


def show(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    table = Table(*columns, title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for row in rows:
        table.add_row(*row)
    CONSOLE.print(table)


def hard_cases(seeds: int) -> Iterable[list[str]]:
    for name, case_of in HARD_CASES.items():
        cases = [case_of(seed) for seed in range(seeds)]
        errors = [joint_errors(case, fit) for case, fit in zip(cases, fit_cases(cases), strict=True)]
        right = [e for e in errors if e.type == cases[0].kind]
        undetermined = sum(e.undetermined for e in errors) / seeds
        yield [name, cases[0].kind, types(errors), *figures(right or errors), f"{undetermined:.0%}", *coverage(right)]


def types(errors: Sequence[JointErrors]) -> str:
    return ", ".join(
        f"{kind} {count / len(errors):.0%}" for kind, count in Counter(e.type for e in errors).most_common()
    )


def figures(errors: Sequence[JointErrors]) -> list[str]:
    """Median and largest error of the axis, the axis line, and the values."""
    axes = [e.axis for e in errors if not math.isnan(e.axis)]
    positions = [e.position for e in errors if not math.isnan(e.position)]
    # Of a cylindrical joint's two kinds of values neither unit is right.
    unit = {"prismatic": 1.0, "cylindrical": math.nan}.get(errors[0].type, math.degrees(1))
    values = [e.value * unit for e in errors if not math.isnan(e.value * unit)]
    return [middle_and_worst(axes), middle_and_worst(positions), middle_and_worst(values)]


def middle_and_worst(values: Sequence[float]) -> str:
    return f"{statistics.median(values):.2g} / {max(values):.2g}" if values else "-"


def coverage(errors: Sequence[JointErrors]) -> list[str]:
    out = []
    for flags in ([e.axis_covered for e in errors], [e.values_covered for e in errors]):
        known = [flag for flag in flags if flag is not None]
        out.append(f"{sum(known) / len(known):.1%}" if len(known) >= 20 else "-")
    return out


def calibration(seeds: int) -> Iterable[list[str]]:
    """Random boxes, axes, travels and covariances; only fits of the right type have a region to compare."""
    for kind in ("revolute", "prismatic", "screw", "cylindrical", "spherical"):
        for states in (2, 3, 4, 5, 10):
            if kind in types_for(states):
                cases = [random_case(1000 * states + seed, kind, states) for seed in range(seeds)]
                errors = [joint_errors(case, fit) for case, fit in zip(cases, fit_cases(cases), strict=True)]
                right = [e for e in errors if e.type == kind]
                yield [kind, str(states), f"{len(right) / seeds:.1%}", *figures(right), *coverage(right)]


def trees(seeds: int) -> Iterable[list[str]]:
    for name, case_of in TREE_CASES.items():
        for states in (2, 3, 10):
            exact, right_types = 0, 0
            for seed in range(seeds):
                case = case_of(seed, states)
                tree = infer_tree(case.points, case.motions, root=1, noise=case.noise)
                exact += case.right_edges(tree) == len(case.truth.joints)
                right_types += all(j.fit.type == "revolute" for j in tree.joints)
            yield [name, str(states), f"{exact} of {seeds}", f"{right_types} of {seeds}"]


def growth(states: int) -> Iterable[list[str]]:
    for parts in (2, 4, 8, 15, 30):
        case = random_object(parts, states)
        start = time.process_time()
        tree = infer_tree(case.points, case.motions, root=1, noise=case.noise)
        seconds = time.process_time() - start
        pairs = parts * (parts - 1) // 2
        right = f"{case.right_edges(tree)} of {parts - 1}"
        yield [str(parts), str(states), f"{seconds:.2f}", f"{1000 * seconds / pairs:.1f}", right]


def against_descent() -> Iterable[list[str]]:
    """All pairs of an object by both methods; residuals of the true joints that both give the right type."""
    for noise in (0.001, 1e-9):
        case = random_object(5, 2, noise=noise)
        radius = object_radius(case.points)
        start = time.process_time()
        ours = fit_pairs(case.points, case.motions, radius, noise=noise)
        middle = time.process_time()
        theirs = descend_pairs(case.points, case.motions, radius)
        seconds = middle - start, time.process_time() - middle
        edges = [(j.parent, j.child) for j in case.truth.joints if ours[j.parent, j.child].type == j.fit.type]
        edges = [edge for edge in edges if theirs[edge].type == ours[edge].type]
        axes = {(j.parent, j.child): j.fit.axis for j in case.truth.joints}
        residuals = [[fits[edge].residual / radius for edge in edges] for fits in (ours, theirs)]
        errors = [[axis_angle(fits[edge].axis, axes[edge]) for edge in edges] for fits in (ours, theirs)]
        yield [
            f"{noise:g}",
            f"{seconds[0]:.3f}",
            f"{seconds[1]:.1f}",
            f"{seconds[1] / seconds[0]:.0f}",
            *(f"{statistics.mean(of):.2g}" for of in (*residuals, *errors)),
            f"{len(edges)} of 4",
        ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200, help="random draws a case")
    seeds = parser.parse_args().seeds
    torch.set_num_threads(1)
    errors = ("axis, deg", "axis line, R", "values, deg or R")
    show(
        "Hard cases; errors: median / largest of the fits of the right type (of all, if there is none)",
        ("case", "truth", "found", *errors, "undetermined", "axis in 95 %", "values in 95 %"),
        hard_cases(seeds),
    )
    show(
        "Calibration: random covariances",
        ("type", "states", "right type", *errors, "axis in 95 %", "values in 95 %"),
        calibration(seeds),
    )
    show("Trees of equal axes", ("case", "states", "exact", "types right"), trees(max(1, seeds // 10)))
    columns = ("parts", "states", "s", "ms a pair", "edges right")
    show("Joint stage, growth", columns, [row for states in (2, 5, 10) for row in growth(states)])
    show(
        "10 pairs at 2 states, against the paper's gradient descent (3,000 steps a type)",
        ("noise, R", "s", "descent, s", "times faster", "residual, R", "descent", "axis, deg", "descent", "joints"),
        against_descent(),
    )


if __name__ == "__main__":
    main()
