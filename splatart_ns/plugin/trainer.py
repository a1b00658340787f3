"""How the runs of all stages are trained, saved, and found by the stages after them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from splatart_ns.errors import DISK_ERRORS, InputError
from splatart_ns.plugin.compat import saved_aside


@dataclass
class LaterPipelineConfig(VanillaPipelineConfig):
    """Of a stage that goes on from what runs of an earlier one found."""

    runs_dir: Path | None = None
    """Where runs are looked for that are not named; --output-dir when not given."""


@dataclass
class StageTrainerConfig(TrainerConfig):
    """A run of one stage."""

    _target: type = field(default_factory=lambda: StageTrainer)

    def save_config(self) -> None:
        """Write config.yml, which `ns-train` does first of all.

        Raises:
            InputError: no capture is given; or a checkpoint to go on from, in which nothing is of what a stage makes of
                views and cameras on its way.
        """
        manager = self.pipeline.datamanager
        if manager.data is None and manager.dataparser.data == Path():  # the parser's default
            raise InputError("No capture is given; give its folder by --data.")
        if self.load_dir is not None or self.load_checkpoint is not None:
            raise InputError(
                "A stage is trained as a whole and does not go on from a checkpoint; leave --load-dir and "
                "--load-checkpoint out."
            )
        super().save_config()

    def setup(self, **kwargs) -> Trainer:
        if isinstance(self.pipeline, LaterPipelineConfig) and self.pipeline.runs_dir is None:
            self.pipeline.runs_dir = self.output_dir
        return super().setup(**kwargs)


class StageTrainer(Trainer):
    """Leaves whole checkpoints only, and says why it cannot write one."""

    def train(self) -> None:
        with errors_of_saving(self.checkpoint_dir):
            super().train()

    def save_checkpoint(self, step: int) -> None:
        with saved_aside(self):
            super().save_checkpoint(step)


@contextmanager
def errors_of_saving(folder: Path) -> Iterator[None]:
    """Turn what a full disk raises into an `InputError`; torch does not say why a checkpoint cannot be written."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        why = error.strerror if isinstance(error, OSError) and error.errno in DISK_ERRORS else None
        if "inline_container.cc" in str(error):
            why = "torch could not save a checkpoint"
        if why is None:
            raise
        where = getattr(error, "filename", None) or folder
        raise InputError(f"{where}: cannot be written ({why}); check the space on the disk.") from error
