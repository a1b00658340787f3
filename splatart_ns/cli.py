"""The command `splatart`: a thin front of the package."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated, Literal

# A spinning OpenMP pool makes two busy processes on one machine many times slower; it is read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import tyro
from rich.console import Console

from splatart_ns.errors import InputError

CONSOLE = Console()


def fit(
    capture: Annotated[Path, tyro.conf.Positional],
    output_dir: Path,
    quality: Literal["draft", "standard", "high"] = "standard",
    root: str | None = None,
    seed: int = 0,
) -> None:
    """Fit an articulated splat to a capture: all stages, resumed after the last finished one.

    Args:
        capture: Folder of the capture.
        output_dir: Folder of the bundle; created, or continued when it holds an unfinished fit.
        quality: draft is fast, high is slow.
        root: Name of the part that the others hang on; chosen when not given.
        seed: Seed of everything random.
    """
    from splatart_ns.plugin.fit import fit as run

    run(capture, output_dir, quality=quality, root=root, seed=seed)


def evaluate(bundle: Annotated[Path, tyro.conf.Positional], data: Path) -> None:
    """Compare a bundle with a capture's ground truth and test views; writes metrics.json into the bundle.

    Args:
        bundle: Folder that `splatart fit` left.
        data: Folder of the capture.
    """
    from splatart_ns.evaluation.evaluate import evaluate as run
    from splatart_ns.evaluation.tables import format_tables

    for table in format_tables(run(bundle, data)):
        CONSOLE.print(table)


def check(capture: Annotated[Path, tyro.conf.Positional]) -> None:
    """Say what is wrong with a capture, frame by frame, and how to mend it.

    Args:
        capture: Folder of the capture.
    """
    from splatart_ns.capture.check import check_capture

    problems = check_capture(capture)
    for problem in problems:
        CONSOLE.print(
            f"[bold]{problem.severity}[/bold] {problem.file}: {problem.message} {problem.mend}", soft_wrap=True
        )
    errors = sum(problem.severity == "error" for problem in problems)
    CONSOLE.print(f"{errors} errors, {len(problems) - errors} warnings")
    if errors:
        raise SystemExit(2)


def main() -> None:
    """Run the command line. A user's mistake gets one sentence and exit code 2."""
    commands = {"fit": fit, "eval": evaluate, "check": check}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="splatart")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(130) from None
