"""All that touches nerfstudio's private behaviour."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from splatart_ns.errors import InputError


def allow_checkpoint_scalars() -> None:
    """Let `torch.load(weights_only=True)` read nerfstudio's checkpoints.

    Its schedulers store NumPy scalars, which torch >= 2.6 refuses by default. They hold a number and nothing else.
    """
    torch.serialization.add_safe_globals([np.core.multiarray.scalar, np.dtype, type(np.dtype("float64"))])


def seed_everything(seed: int) -> None:
    """What `ns-train` does with `machine.seed` before it starts."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


class _TagBlindLoader(yaml.SafeLoader):
    """Reads nerfstudio's config.yml as plain data; Python tags build nothing."""


def _plain(loader: yaml.SafeLoader, _suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_TagBlindLoader.add_multi_constructor("tag:yaml.org,2002:python/", _plain)


def read_run_config(config: Path) -> dict[str, Any]:
    """The fields of a run's config.yml, nested dicts and lists of plain values. Nothing is executed.

    Raises:
        InputError: when the file cannot be read.
    """
    try:
        fields = yaml.load(config.read_text(), Loader=_TagBlindLoader)  # a SafeLoader: builds plain values only
    except (OSError, yaml.YAMLError) as error:
        raise InputError(f"{config} cannot be read as a nerfstudio config ({error}); train that stage again.") from None
    if not isinstance(fields, dict):
        raise InputError(f"{config} does not hold a nerfstudio config; train that stage again.")
    return fields


def read_checkpoint(config: Path) -> dict[str, torch.Tensor]:
    """The pipeline state of the newest checkpoint beside a run's config.yml.

    Raises:
        InputError: when there is none or it cannot be read.
    """
    folder = config.parent / "nerfstudio_models"
    files = sorted(folder.glob("step-*.ckpt"))
    if not files:
        raise InputError(f"{folder} holds no checkpoint (step-*.ckpt); train that stage again.")
    try:
        return torch.load(files[-1], map_location="cpu", weights_only=True)["pipeline"]
    except Exception as error:  # torch raises many types for a broken file
        raise InputError(f"{files[-1]} cannot be read ({type(error).__name__}); train that stage again.") from None


allow_checkpoint_scalars()
