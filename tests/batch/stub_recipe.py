"""Stages that write tiny files, and do what an object's settings say."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatart_ns.batch.stage import Needs, Stage, fingerprint, stage_key
from splatart_ns.errors import InputError


@dataclass(frozen=True)
class StubRecipe:
    """Look at the parts of a capture, copy each in capitals side by side, then put them together."""

    log: str = ""
    """File that gets a line whenever a stage has left its result."""
    seconds: float = 0.0
    """What each stage takes."""
    gpu: bool = False
    """Whether copies are made on a GPU."""

    def fingerprint(self, entry):
        return fingerprint(entry.capture)

    def stages(self, entry, fingerprint, told) -> list[Stage]:
        look = Stage("look", stage_key("look", fingerprint))
        if told is None:
            return [look]
        seed = entry.settings.get("seed", 0)
        copies = [
            Stage(f"copy {name}", stage_key("copy", name, text, seed), ("look",), Needs(gpu=self.gpu))
            for name, text in told["texts"].items()
        ]
        key = stage_key("join", [copy.key for copy in copies], entry.settings.get("root"))
        needs = Needs(memory_mb=200)
        return [look, *copies, Stage("join", key, tuple(copy.name for copy in copies), needs)]

    def run(self, stage, work) -> tuple[dict[str, Any], list[str]]:
        time.sleep(self.seconds)
        kind, _, name = stage.partition(" ")
        if work.entry.settings.get("at", "join") == kind:
            self._misbehave(work)
        if kind == "look":
            with work.capture() as folder:
                texts = {file.name: file.read_text() for file in sorted(folder.iterdir())}
            result = {"texts": texts}, []
        elif kind == "copy":
            (work.folder / "copies").mkdir()
            text = work.outcome("look")["texts"][name].upper()
            (work.folder / "copies" / name).write_text(text, errors="backslashreplace")
            result = (
                {"threads": os.environ.get("OMP_NUM_THREADS", ""), "gpu": os.environ.get("CUDA_VISIBLE_DEVICES", "")},
                [f"copies/{name}"],
            )
        else:
            work.fetch("copies")
            texts = [file.read_text() for file in sorted((work.folder / "copies").iterdir())]
            (work.folder / "joined.txt").write_text(" ".join(texts))
            result = {"root": work.entry.settings.get("root")}, ["joined.txt"]
        if self.log:
            with open(self.log, "a") as log:
                log.write(f"{work.entry.name} {stage}\n")
        return result

    def outcome_shape(self, stage):
        shapes = {"look": {"texts": {"one": str, "two": str}}, "join": {"root": (str, None)}}
        return shapes.get(stage, dict)

    def row(self, entry, outcomes) -> dict[str, Any]:
        return {
            "parts": list(outcomes["look"]["texts"]),
            "root": outcomes["join"]["root"],
            "joints": [],
            "failed_checks": [],
        }

    def _misbehave(self, work) -> None:
        match work.entry.settings.get("do"):
            case "mistake":
                raise InputError(f"{work.entry.name}: cannot be fitted; mend it.")
            case "crash":
                raise ZeroDivisionError("something\nby zero")
            case "die":
                os.kill(os.getpid(), signal.SIGKILL)
            case "die once":
                flag = Path(work.entry.settings["flag"])
                if not flag.exists():
                    flag.touch()
                    os.kill(os.getpid(), signal.SIGKILL)
            case "leave half":
                (work.folder / "copies").mkdir(exist_ok=True)
                (work.folder / "copies/half").write_text("half")
                raise OSError("no space left")
