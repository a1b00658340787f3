"""What a batch does with a capture: `splatart fit` in pieces, exports, and a summary for the report."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatart_ns.batch.entry import Entry
from splatart_ns.batch.stage import Needs, Stage, Work, fingerprint, stage_key
from splatart_ns.errors import InputError
from splatart_ns.files import write_json
from splatart_ns.shape import NUMBER

# What a stage needs is imported when it runs: the process that only hands out stages starts at once and stays small.
if TYPE_CHECKING:
    from splatart_ns.plugin.settings import Settings

_BASE_MB = 1100
"""Memory of a process that has loaded the libraries, and of the Gaussians."""
_BYTES_PER_PIXEL = 60
"""Memory of a cached pixel of a training view, over all that a stage keeps of it."""
_THUMBNAIL = 96
"""Rows and columns of a picture in the report."""


_CHECK = {"digest": str, "worlds": str, "downscale": int, "states": [{"name": str, "digest": str, "pixels": int}]}
_TRAINING = {"seconds": NUMBER, "notes": [str]}
_POSE = _TRAINING | {"device": str, "rasterizer": str}
_EXPORT = {"failed_checks": [str], "notes": [str]}
_JOINT = {"name": str, "type": str, "parent": str, "child": str, "residual": NUMBER, "ambiguous": bool}
_SUMMARY = {
    **{"parts": [str], "root": str, "states": int, "length_unit": str, "gaussians": int},
    **{"joints": [_JOINT | {"axis_deviation": (NUMBER, None)}], "movable": int, "unattached": int},
    **{"notes": [str], "thumbnails": [str]},
}


@dataclass(frozen=True)
class Fitting:
    """Bundles as `splatart fit` with one thread leaves them, and their exports."""

    rasterizer: str = "auto"
    exports: tuple[str, ...] = ()

    def fingerprint(self, entry: Entry) -> str:
        return fingerprint(entry.capture)

    def stages(self, entry: Entry, fingerprint: str, told: dict[str, Any] | None) -> list[Stage]:
        package, settings = version("splatart-ns"), entry.settings
        last = [settings["root"], settings["joints"]]
        looks = [settings["quality"], settings["downscale"]]
        check = Stage("check", stage_key("check", package, fingerprint, looks, last))
        if told is None:
            return [check]
        # How much smaller all states' images are looked at, the sizes of all of them decide.
        fitting = [settings["quality"], settings["seed"], self.rasterizer, told["downscale"]]

        def needs(pixels: int) -> Needs:
            return Needs(memory_mb=_BASE_MB + pixels * _BYTES_PER_PIXEL // 2**20, gpu=True)

        semantic = [
            Stage(name, stage_key(name, package, fitting, state["digest"]), (check.name,), needs(state["pixels"]))
            for name, state in ((f"semantic {state['name']}", state) for state in told["states"])
        ]
        # The root brings worlds together, before it is the base of the tree.
        root = [] if told["worlds"] == "shared" else [settings["root"]]
        key = stage_key("pose", package, fitting, told["digest"], [stage.key for stage in semantic], *root)
        pixels = sum(state["pixels"] for state in told["states"])
        pose = Stage("pose", key, tuple(stage.name for stage in semantic), needs(pixels))
        light = Needs(memory_mb=_BASE_MB + pixels * _BYTES_PER_PIXEL // 2**20)
        joint = Stage("joint", stage_key("joint", pose.key, last), (pose.name,), light)
        light = Needs(memory_mb=_BASE_MB)
        exports = [
            Stage(f"export {form}", stage_key("export", form, joint.key), (joint.name,), light) for form in self.exports
        ]
        summary = Stage("summary", stage_key("summary", joint.key), (joint.name,), light)
        return [check, *semantic, pose, joint, *exports, summary]

    def run(self, stage: str, work: Work) -> tuple[dict[str, Any], Sequence[str]]:
        import torch

        from splatart_ns.rasterize.rasterization import set_backend

        torch.set_num_threads(1)  # the same sums on every machine
        kind, _, which = stage.partition(" ")
        sees_gpu = kind in ("semantic", "pose")
        set_backend(self.rasterizer if sees_gpu or self.rasterizer != "gsplat" else "auto")
        match kind:
            case "check":
                return _check(work, self._settings(work)), ()
            case "export":
                return _export(work, which)
            case "summary":
                return _summarize(work), ()
            case _:
                return _train(work, stage, self._settings(work))

    def outcome_shape(self, stage: str) -> Any:
        return {"check": _CHECK, "export": _EXPORT, "summary": _SUMMARY, "pose": _POSE}.get(
            stage.partition(" ")[0], _TRAINING
        )

    def row(self, entry: Entry, outcomes: dict[str, dict[str, Any]]) -> dict[str, Any]:
        return {key: outcomes["summary"][key] for key in _SUMMARY} | {
            "failed_checks": sum((outcomes[f"export {form}"]["failed_checks"] for form in self.exports), [])
        }

    def _settings(self, work: Work) -> Settings:
        from splatart_ns.plugin.imports import few_imports

        with few_imports():
            from splatart_ns.plugin.settings import Settings

        given = work.entry.settings
        return Settings(
            *(given["quality"], given["root"], given["seed"], self.rasterizer, list(given["joints"])),
            downscale=given["downscale"],
        )


def _check(work: Work, settings: Settings) -> dict[str, Any]:
    """Whether the capture can be fitted, what it is, and how much of it there is to hold in memory."""
    from splatart_ns.capture.digest import capture_digest
    from splatart_ns.plugin.settings import require_fittable

    with work.capture() as path:
        capture = require_fittable(path, settings)
        downscale = settings.of(capture).downscale
        shared = repr((capture.normalization.centre.tolist(), capture.normalization.scale))
        return {
            "digest": capture_digest(capture),
            "worlds": capture.worlds,
            "downscale": downscale,
            "states": [
                {
                    "name": state.name,
                    "digest": stage_key(capture_digest(capture, [state]), shared),
                    "pixels": sum(f.camera.width * f.camera.height for f in state.frames) // downscale**2,
                }
                for state in capture.states
            ],
        }


def _train(work: Work, stage: str, settings: Settings) -> tuple[dict[str, Any], list[str]]:
    """A stage of the fit, from the runs that earlier ones have left."""
    from splatart_ns.capture.formats import load_capture
    from splatart_ns.plugin.report import TRAINED_ON, report_head
    from splatart_ns.plugin.stage_configs import stage_configs
    from splatart_ns.plugin.stage_run import run_stage

    with work.capture() as path:
        capture = load_capture(path)
        configs = stage_configs(capture, work.folder, settings)
        earlier = {"pose": [name for name in configs if name.startswith("semantic ")], "joint": ["pose"]}
        for name in earlier.get(stage, []):
            work.fetch(_run_folder(configs[name], work.folder))
        outcome = run_stage(configs[stage], lambda steps: None)
        if stage == "pose":
            outcome |= {key: report_head(capture, settings)[key] for key in TRAINED_ON}
        # The run shall open where it will lie.
        at_home = stage_configs(capture, work.home, settings)[stage]
        run = configs[stage].get_base_dir()
        _write_config(at_home, run / "config.yml")
        kept = [_run_folder(configs[stage], work.folder)]
        if stage == "joint":
            done = {name: work.outcome(name) for name in configs if name != stage} | {stage: outcome}
            told = report_head(capture, settings) | {"capture": work.entry.capture, **_stages_of_report(done)}
            told |= {key: done["pose"][key] for key in TRAINED_ON}
            write_json(work.folder / "report.json", told)
            kept += ["report.json", "parts", "articulation.json"]
            work.discard("metrics.json", "export")  # which are of the bundle before
    return outcome, kept


def _run_folder(config: Any, bundle: Path) -> str:
    """Where a stage's run lies in the bundle; `config` is nerfstudio's TrainerConfig."""
    return config.get_base_dir().relative_to(bundle).as_posix()


def _write_config(config: Any, path: Path) -> None:
    """As `TrainerConfig.save_config` does, which writes to where the run lies."""
    import yaml

    path.write_text(yaml.dump(config), encoding="utf-8")


def _stages_of_report(outcomes: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """As `splatart fit` tells them, which can go on from there."""
    told = [{"name": name, "wall_seconds": outcome["seconds"], **outcome} for name, outcome in outcomes.items()]
    return {"stages": told, "seconds": round(sum(stage["seconds"] for stage in told), 2)}


def _export(work: Work, form: str) -> tuple[dict[str, Any], list[str]]:
    from splatart_ns.bundle import export as exports
    from splatart_ns.bundle import load_bundle

    exports.require((form,))
    work.fetch("articulation.json", "parts")
    bundle = load_bundle(work.folder)
    shapes = exports.part_shapes(bundle) if form not in exports.WITHOUT_MESHES else None
    robot = exports.describe(bundle, shapes, work.entry.name.rsplit("/", 1)[-1])
    folder = work.folder / "export" / form
    path = exports.export(bundle, robot, form, folder)
    checks = exports.validate(path, form, bundle, robot)
    failed = [f"{form}: {check.program}, {check.what}: {check.found}" for check in checks if check.verdict == "failed"]
    return {"failed_checks": failed, "notes": list(robot.notes)}, [f"export/{form}"]


def _summarize(work: Work) -> dict[str, Any]:
    """What a row of the report shows."""
    from splatart_ns.bundle import load_bundle
    from splatart_ns.bundle.bundle import JOINT_DOFS
    from splatart_ns.bundle.joint_axis import direction_deviation

    work.fetch("articulation.json", "parts")
    bundle = load_bundle(work.folder)
    stages = [*(f"semantic {state}" for state in bundle.states), "pose", "joint"]
    joints = [
        {
            "name": joint.name,
            "type": joint.type,
            "parent": joint.parent,
            "child": joint.child,
            "residual": joint.residual,
            "axis_deviation": None if (sd := direction_deviation(joint)) is None else math.degrees(sd),
            "ambiguous": joint.ambiguous,
        }
        for joint in bundle.tree_joints
    ]
    return {
        "parts": bundle.part_names,
        "root": bundle.root,
        "states": len(bundle.states),
        "length_unit": bundle.length_unit,
        "gaussians": sum(len(part.splat) for part in bundle.parts),
        "joints": joints,
        "movable": sum(JOINT_DOFS[joint["type"]] > 0 for joint in joints),
        "unattached": len(bundle.parts) - 1 - len(joints),
        "notes": sum((work.outcome(stage)["notes"] for stage in stages), []),
        "thumbnails": _thumbnails(bundle),
    }


def _thumbnails(bundle: Any) -> list[str]:
    """JPEGs, base64, of the object at the first state and with every joint at the far end of what was observed."""
    from PIL import Image

    from splatart_ns.bundle import ArticulatedSplat, animation, camera, configurations

    far = {
        joint.name: max(joint.limits, key=abs)
        for joint in configurations.movable_joints(bundle).values()
        if joint.limits is not None
    }
    path = [{}, far]
    try:
        sphere = camera.bounding_sphere(bundle, path)
    except InputError:  # nothing can be seen
        return []
    view = camera.orbit_camera(*sphere, camera.front_azimuth(bundle), camera.ELEVATION, _THUMBNAIL, _THUMBNAIL)
    pictures = []
    for frame in animation.render_frames(ArticulatedSplat(bundle), path, view):
        data = io.BytesIO()
        Image.fromarray(frame).save(data, "JPEG", quality=80)
        pictures.append(base64.b64encode(data.getvalue()).decode())
    return pictures
