"""All that touches nerfstudio's private behaviour."""

from __future__ import annotations

import os
import random
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerControl

from splatart_ns.errors import InputError
from splatart_ns.plain_yaml import parse_yaml


def allow_checkpoint_scalars() -> None:
    """Let `torch.load(weights_only=True)` read nerfstudio's checkpoints.

    Its schedulers store NumPy scalars, which torch >= 2.6 refuses by default. They hold a number and nothing else.
    """
    torch.serialization.add_safe_globals([np.core.multiarray.scalar, np.dtype, type(np.dtype("float64"))])


def report_input_errors() -> None:
    """Let nerfstudio's commands end with one sentence and exit code 2 where an `InputError` ends them.

    Only what nobody catches comes here: `splatart fit` and notebooks get the exception itself.
    """
    previous = sys.excepthook

    def report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        if issubclass(kind, InputError):
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2)  # Python honours it here, as anywhere
        previous(kind, error, trace)

    sys.excepthook = report


def seed_everything(seed: int) -> None:
    """What `ns-train` does with `machine.seed` before it starts."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def stop_event_writers() -> None:
    """Let a trainer that was set up write no events: they cost a tenth of a small capture's step."""
    writer.EVENT_WRITERS.clear()


@dataclass
class FusedAdamOptimizerConfig(AdamOptimizerConfig):
    """Adam in one kernel; nerfstudio hands all fields to torch."""

    fused: bool = True
    """One pass over memory in place of a dozen."""


def read_run_config(config: Path) -> dict[str, Any]:
    """The fields of a run's config.yml, nested dicts and lists of plain values. Nothing is executed.

    Raises:
        InputError: when the file cannot be read.
    """
    try:
        fields = parse_yaml(config.read_text(encoding="utf-8"), ignore_tags=True) if config.is_file() else None
    except (OSError, ValueError) as error:
        raise InputError(f"{config} cannot be read as a nerfstudio config ({error}); train that stage again.") from None
    if not isinstance(fields, dict):
        raise InputError(f"{config} does not hold a nerfstudio config; train that stage again.")
    return fields


def run_setting(config: Path, *names: str) -> Any:
    """What a run's config.yml has under these names, each below the one before.

    Raises:
        InputError: when the file cannot be read or has no such field.
    """
    value: Any = read_run_config(config)
    for name in names:
        if not isinstance(value, dict) or name not in value:
            raise InputError(f"{config} has no {'.'.join(names)}; train that stage again.")
        value = value[name]
    return value


def read_checkpoint(
    config: Path, shapes: Mapping[str, Sequence[int | str]], other: str | None = None
) -> dict[str, torch.Tensor]:
    """The pipeline state of the newest checkpoint beside a run's config.yml.

    `shapes` are those of the tensors that it must have: sizes, or words that stand for the same size everywhere.
    `other` is what to say of one that has them not.

    Raises:
        InputError: when there is none, it cannot be read, or has not these tensors.
    """
    folder = config.parent / "nerfstudio_models"
    files = sorted(folder.glob("step-*.ckpt"))
    if not files:
        raise InputError(f"{folder} holds no checkpoint (step-*.ckpt); train that stage again.")
    if not files[-1].is_file():
        raise InputError(f"{files[-1]} is not a file; train that stage again.")
    try:
        state = torch.load(files[-1], map_location="cpu", weights_only=True)["pipeline"]
    except Exception as error:  # torch raises many types for a broken file
        raise InputError(f"{files[-1]} cannot be read ({type(error).__name__}); train that stage again.") from None
    sizes: dict[str, int] = {}
    for name, shape in shapes.items():
        tensor = state.get(name) if isinstance(state, dict) else None
        if not isinstance(tensor, torch.Tensor) or not _has_sizes(tensor, shape, sizes):
            wanted = ", ".join(map(str, shape))
            found = f"{files[-1]} has no '{name}' of the shape [{wanted}]"
            raise InputError(other or f"{found}; train that stage again.")
    return state


def _has_sizes(tensor: torch.Tensor, shape: Sequence[int | str], sizes: dict[str, int]) -> bool:
    """Whether a tensor has this shape; `sizes` are those of the words that are known, and gets the others."""
    if tensor.ndim != len(shape) or tensor.layout is not torch.strided:
        return False
    pairs = zip(shape, tensor.shape, strict=True)
    return all(size == (sizes.setdefault(s, size) if isinstance(s, str) else s) for s, size in pairs)


@contextmanager
def saved_aside(trainer: Trainer) -> Iterator[None]:
    """A block in which a trainer saves a checkpoint: it gets its name, and older ones go, when all of it is written."""
    folder = trainer.checkpoint_dir
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".saving-") as aside:
        trainer.checkpoint_dir = Path(aside)  # where `save_checkpoint` writes
        try:
            yield
        finally:
            trainer.checkpoint_dir = folder
        older = list(folder.glob("*.ckpt")) if trainer.config.save_only_latest_checkpoint else []
        new = [file.replace(folder / file.name) for file in Path(aside).glob("*.ckpt")]
        for file in older:
            if file not in new:
                file.unlink()


def finished_runs(runs_dir: Path, capture: Path, method: str) -> list[Path]:
    """The config.yml of every run of a method on a capture, below `runs_dir`, that took all its steps; oldest first.

    One that cannot be read may be of another capture, and does not count.
    """
    configs = runs_dir.glob(f"*/{method}/*/config.yml")
    saved = [c for c in configs if _saved_steps(c) > 0]
    on_capture = [c for c in saved if _is_of(c, os.path.realpath(capture))]
    finished = [c for c in on_capture if _saved_steps(c) >= _steps_of(c)]
    return sorted(finished, key=lambda config: config.stat().st_mtime)


def _saved_steps(config: Path) -> int:
    """How many steps a run had taken at its newest checkpoint; 0 if it has left none, or one that was cut off."""
    newest = max(config.parent.glob("nerfstudio_models/step-*.ckpt"), default=None)
    number = "" if newest is None else newest.stem.removeprefix("step-")
    if not number.isdecimal() or not zipfile.is_zipfile(newest):  # torch's files end with their list of contents
        return 0
    return int(number) + 1


def _steps_of(config: Path) -> int:
    """How many steps a run was to take."""
    steps = run_setting(config, "max_num_iterations")
    if not isinstance(steps, int):
        raise InputError(f"{config} does not say how many steps its run was to take; train that stage again.")
    return steps


def _is_of(config: Path, capture: str) -> bool:
    try:
        return _data_of(config) == capture
    except InputError as error:
        CONSOLE.log(f"Passed over: {error}", markup=False)
        return False


def _data_of(config: Path) -> str:
    """Where the data of a run are; paths are lists of their parts in config.yml."""
    parts = run_setting(config, "pipeline", "datamanager", "data")
    parts = parts or run_setting(config, "pipeline", "datamanager", "dataparser", "data") or []
    if not isinstance(parts, list) or not all(isinstance(part, str) and "\0" not in part for part in parts):
        raise InputError(f"{config} does not say where its capture is; train that stage again.")
    return os.path.realpath(Path(*parts))


class StartView(ViewerControl):
    """Shows who connects to the viewer an object of radius 1 about the origin as a whole."""

    DISTANCE = 1.8

    def __init__(self, direction: np.ndarray):
        self.position = self.DISTANCE * direction / np.linalg.norm(direction)

    def _setup(self, viewer) -> None:
        super()._setup(viewer)
        self.viser_server.on_client_connect(self._place)

    def _place(self, client) -> None:
        from nerfstudio.viewer.viewer import VISER_NERFSTUDIO_SCALE_RATIO

        with client.atomic():
            client.camera.position = VISER_NERFSTUDIO_SCALE_RATIO * self.position
            client.camera.look_at = np.zeros(3)


allow_checkpoint_scalars()
report_input_errors()
