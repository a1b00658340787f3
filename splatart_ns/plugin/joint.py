"""Stages 3 to 5 in nerfstudio: joints, the tree, and a model with one slider a joint."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.viewer.viewer_elements import ViewerSlider
from torch import Tensor, nn
from torch.nn.functional import pad

from splatart_ns.bundle.assemble import assemble_bundle
from splatart_ns.bundle.bundle import Bundle
from splatart_ns.bundle.description import describe
from splatart_ns.bundle.folder import save_bundle
from splatart_ns.bundle.sliders import freedoms, slider_range, unit_name
from splatart_ns.bundle.vantage import vantage_points
from splatart_ns.capture.capture import Capture, Normalization
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import se3_exp, se3_log
from splatart_ns.plugin.compat import finished_runs, read_checkpoint
from splatart_ns.plugin.gaussians import SPLAT_SHAPES, gauss_params_from_splat, splat_from_state
from splatart_ns.plugin.model import SplatartModel, SplatartModelConfig, refuse_unread
from splatart_ns.plugin.trainer import LaterPipelineConfig, StageTrainer, StageTrainerConfig, errors_of_saving
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics, shifted
from splatart_ns.stages.joint import leaves_unexplained
from splatart_ns.stages.joint_constraint import parse_constraints
from splatart_ns.stages.joint_fit import JointFit
from splatart_ns.stages.joint_parameters import JOINT_DOFS, JOINT_LENGTHS
from splatart_ns.stages.pose import carry
from splatart_ns.stages.tree import EPSILON, JointMethod, infer_tree
from splatart_ns.stages.unseen import known_states, place_unseen

JOINT_TYPES = tuple(JOINT_DOFS)
MIN_POINT_OPACITY = 0.3
"""Fainter Gaussians say little of where a part's surface is."""


@dataclass
class JointModelConfig(SplatartModelConfig):
    """An articulated splat; the viewer shows one slider a joint."""

    _target: type = field(default_factory=lambda: JointModel)


class JointModel(SplatartModel):
    """Merged parts on a kinematic tree, posed by forward kinematics. Its buffers are in the normalised world."""

    def populate_modules(self) -> None:
        super().populate_modules()
        self.state = self.kwargs["metadata"]["state"]
        eye = torch.eye(4, dtype=torch.float64).repeat(1, self.num_parts, 1, 1)
        self._set_joints(self._no_joints() | {"motions": eye})

    @staticmethod
    def _no_joints() -> dict[str, Tensor]:
        double = {"dtype": torch.float64}
        return {
            "joint_parts": torch.zeros(0, 2, dtype=torch.long),  # parent and child
            "joint_types": torch.zeros(0, dtype=torch.long),  # of JOINT_TYPES
            "joint_axes": torch.zeros(0, 3, **double),
            "joint_origins": torch.zeros(0, 3, **double),
            "joint_pitches": torch.zeros(0, **double),
            "joint_values": torch.zeros(0, 1, 6, **double),  # joint, state, degree of freedom
            "root": torch.tensor(1),
            "motions": torch.zeros(1, 1, 4, 4, **double),
        }

    def _set_joints(self, buffers: dict[str, Tensor]) -> None:
        for name, value in buffers.items():
            self.register_buffer(name, value.to(self.palette.device))

    def start(self, splat: Splat, tree: KinematicTree, motions: Tensor, normalization: Normalization) -> None:
        """Show `splat` (normalised world) on `tree`; tree and motions [S, P, 4, 4] are in the capture's world."""
        self.gauss_params = nn.ParameterDict(gauss_params_from_splat(splat.to(self.device)))
        scale = normalization.scale
        fits = [replace(j.fit, values=normal_values(j.fit, normalization)) for j in tree.joints]
        buffers = self._no_joints() | {
            "root": torch.tensor(tree.root),
            "motions": torch.from_numpy(normalization.motion_to_normal(motions.cpu().numpy())),
        }
        if fits:
            buffers |= {
                "joint_parts": torch.tensor([[j.parent, j.child] for j in tree.joints]),
                "joint_types": torch.tensor([JOINT_TYPES.index(f.type) for f in fits]),
                "joint_axes": torch.stack([f.axis for f in fits]),
                "joint_origins": scale
                * (torch.stack([f.origin for f in fits]) - torch.from_numpy(normalization.centre)),
                "joint_pitches": torch.tensor([f.pitch * scale for f in fits]).double(),
                "joint_values": torch.stack([pad(f.values.reshape(len(f.values), -1), (0, 6))[:, :6] for f in fits]),
            }
        self._set_joints(buffers)
        self.add_sliders(scale)

    @property
    def tree(self) -> KinematicTree:
        """The kinematic tree in the normalised world."""
        joints = []
        for parts, kind, axis, origin, pitch, values in zip(
            self.joint_parts.tolist(),
            self.joint_types.tolist(),
            self.joint_axes,
            self.joint_origins,
            self.joint_pitches.tolist(),
            self.joint_values,
            strict=True,
        ):
            dofs = JOINT_DOFS[JOINT_TYPES[kind]]
            values = values[:, :dofs] if dofs > 1 else values[:, 0]
            fit = JointFit(JOINT_TYPES[kind], axis, origin, pitch, values, residual=0.0)
            joints.append(Joint(*parts, fit))
        return KinematicTree(list(range(1, self.num_parts + 1)), int(self.root), joints)

    def add_sliders(self, scale: float) -> None:
        """One slider for each degree of freedom, in degrees or the capture's unit, over the observed range and half
        as much on both sides. `scale` is the normalisation's."""
        self.register_buffer("world_scale", torch.tensor(scale, dtype=torch.float64, device=self.device))
        length_unit = self.kwargs["metadata"]["length_unit"]
        tree = self.tree
        for index, ((joint, what, turns), observed) in enumerate(zip(_freedoms(tree), tree.observed().mT, strict=True)):
            unit = math.degrees(1) if turns else 1 / scale
            ends = float(observed.min()), float(observed.max())
            if joint.fit.type == "revolute" and ends == (0.0, 0.0):  # a round part whose turns nothing tells
                ends = -math.pi, math.pi
            low, high, step = slider_range(*(x * unit for x in ends))
            slider = ViewerSlider(
                name=f"{self.part_names[joint.parent]}_to_{self.part_names[joint.child]}{what} "
                f"({unit_name(turns, length_unit)})",
                default_value=float(observed[min(self.state, len(observed) - 1)]) * unit,
                min_value=low,
                max_value=high,
                step=step,
            )
            # The viewer finds attributes, not lists of them, and shows them in the order of their names.
            setattr(self, f"joint_{index:02d}", slider)

    def configuration(self) -> Tensor:
        """What the sliders say [J], radians and normalised length."""
        q = []
        for index, (_, _, turns) in enumerate(_freedoms(self.tree)):
            value = getattr(self, f"joint_{index:02d}").value
            q.append(math.radians(value) if turns else value * float(self.world_scale))
        return torch.tensor(q, dtype=torch.float64, device=self.device)

    @torch.no_grad()
    def posed_splat(self) -> Splat:
        """All parts as the sliders say; the root, and parts that hang on nothing, where they are at the state shown."""
        tree = self.tree
        motions = self.motions[min(self.state, len(self.motions) - 1)].clone()
        if tree.movable:
            T = forward_kinematics(tree, self.configuration(), root_motion=motions[tree.root - 1])
            hung = [tree.root - 1, *(j.child - 1 for j in tree.joints)]
            motions[hung] = T[hung]
        return carry([self.splat], torch.stack([torch.eye(4).to(motions).expand_as(motions), motions]), 0, 1)

    def load_state_dict(self, state, **kwargs):
        self._set_joints({name: state[name] for name in self._no_joints()})
        self.add_sliders(float(state["world_scale"]))
        return super().load_state_dict(state, **kwargs)


def _freedoms(tree: KinematicTree) -> list[tuple[Joint, str, bool]]:
    """A tree's degrees of freedom in the order of a configuration: the joint, and what `freedoms` says of each."""
    return [(joint, *freedom) for joint in tree.movable for freedom in freedoms(joint.fit.type)]


def normal_values(fit: JointFit, normalization: Normalization) -> Tensor:
    """A joint's values in the normalised world."""
    if fit.type == "free":
        return se3_log(torch.from_numpy(normalization.motion_to_normal(se3_exp(fit.values).numpy(force=True))))
    values = fit.values.clone()
    (values if values.ndim > 1 else values[:, None])[:, : JOINT_LENGTHS.get(fit.type, 0)] *= normalization.scale
    return values


@dataclass
class JointPipelineConfig(LaterPipelineConfig):
    """Stages 3 and 4."""

    _target: type = field(default_factory=lambda: JointPipeline)
    pose_run: Path | None = None
    """The config.yml of the splatart-pose run; the latest one on this capture below `runs_dir` when not given."""
    root: str | None = None
    """Name of the part that the others hang on; chosen when not given."""
    joints: tuple[str, ...] = ()
    """What is known of joints: child:parent, child:parent=type, child:parent=none or child:parent=not-type."""
    epsilon: float = EPSILON
    """Largest residual of an accepted joint, as a share of the object's bounding radius."""
    method: JointMethod = "screw"
    """How joints are fitted: in closed form and refined, or by the paper's gradient descent (slow, for comparison)."""
    seed: int = 0
    """Noted in the bundle."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Noted in the bundle."""


class JointPipeline(VanillaPipeline):
    """Fits joints and tree to the poses of a splatart-pose run."""

    config: JointPipelineConfig

    def __init__(self, config: JointPipelineConfig, device: str, test_mode: str = "val", *args, **kwargs):
        super().__init__(config, device, test_mode, *args, **kwargs)
        if test_mode != "val":  # a checkpoint brings everything
            return
        refuse_unread(self.model.config, "splatart-joint")
        capture = self.datamanager.capture
        normalization = capture.normalization
        state = _read_pose_run(config.pose_run or find_pose_run(config.runs_dir, capture.path), capture)
        splat = splat_from_state(state)
        motions = torch.from_numpy(normalization.motion_to_world(state["_model.poses.base"].numpy()))
        covariances = covariances_to_world(state["_model.covariance"], normalization)
        part_motions = {p: motions[:, p - 1] for p in capture.parts}
        part_covariances = {p: covariances[:, p - 1] for p in capture.parts}
        known = known_states(part_motions, part_covariances)
        self.tree = self._infer_tree(state, splat, known)
        self.notes = [f"{capture.parts[part]}: {reason}" for part, reason in self.tree.unattached.items()]
        self.notes += self.tree.contradicted.values()
        self.notes += [other_parent_note(j, capture.parts) for j in self.tree.joints if j.other is not None]
        untold = [j for j in self.tree.joints if j.child not in self.tree.contradicted]
        self.notes += [unexplained_note(j, capture.parts) for j in untold if leaves_unexplained(j.fit)]
        for note in self.notes:
            CONSOLE.log(note, markup=False)
        if not all(bool(states.all()) for states in known.values()):
            places, part_motions, _ = place_unseen(self.tree, part_motions, known)
            motions = torch.stack([part_motions[p] for p in sorted(capture.parts)], dim=1)
            shift = torch.stack([torch.stack([torch.eye(4).to(X), X]) for _, X in sorted(places.items())], dim=1)
            splat = carry([splat], torch.from_numpy(normalization.motion_to_normal(shift.numpy())), 0, 1)
        self.model.start(splat, self.tree, motions, normalization)
        world, worlds = splat_to_world(splat, normalization), state["_model.worlds"]
        self.bundle: Bundle = assemble_bundle(
            self.tree,
            {p: world.select(world.part_ids == p) for p in capture.parts},
            part_motions,
            part_covariances,
            capture.parts,
            [s.name for s in capture.states],
            capture.length_unit,
            {
                "version": version("splatart-ns"),
                "seed": config.seed,
                "settings": config.settings,
                "cameras": vantage_points(capture, worlds.numpy()),
                **({} if capture.worlds == "shared" else {"worlds": worlds.tolist()}),
            },
        )

    def _infer_tree(self, state: Mapping[str, Tensor], splat: Splat, known: Mapping[int, Tensor]) -> KinematicTree:
        """The tree of a pose run's `state` and its splat, in the capture's world; `known` as of `known_states`."""
        capture, config, ids = self.datamanager.capture, self.config, splat.part_ids
        present = [p for p in capture.parts if bool((ids == p).any())]
        root = next((p for p, name in capture.parts.items() if name == config.root), None)
        if config.root is not None and not (root in present and known[root][0]):
            raise InputError(
                f"{capture.path} has no part '{config.root}' with Gaussians at state 0; choose another root."
            )
        # Joints are found about the object's place: the world's origin may be a thousand objects away, as a map's is.
        here = replace(capture.normalization, centre=np.zeros(3))
        beside = splat_to_world(splat, here)
        motions = torch.from_numpy(here.motion_to_world(state["_model.poses.base"].numpy()))
        covariances = covariances_to_world(state["_model.covariance"], here)
        held = state["_model.held_ratio"]
        tree = infer_tree(
            {p: surface_points(beside.select(ids == p)) for p in present},
            {p: motions[:, p - 1] for p in present},
            covariances={p: covariances[:, p - 1] for p in present},
            root=root,
            render_ratios={
                (a, b): float(held[a - 1, b - 1])
                for a in present
                for b in present
                if a != b and bool(torch.isfinite(held[a - 1, b - 1]))
            },
            epsilon=config.epsilon,
            method=config.method,
            constraints=parse_constraints(config.joints, capture.parts, root),
            names=capture.parts,
        )
        return doubted(shifted(tree, torch.from_numpy(capture.normalization.centre)), state["_model.alike"])


def _read_pose_run(run: Path, capture: Capture) -> dict[str, Tensor]:
    """The checkpoint of a finished splatart-pose run on a capture."""
    S, P = len(capture.states), len(capture.parts)
    other = (
        f"{run} is no finished splatart-pose run on a capture of {S} states and {P} parts; "
        f"run `ns-train splatart-pose --data {capture.path}` again."
    )
    state = read_checkpoint(run, SPLAT_SHAPES | _pose_shapes(S, P), other)
    if not state["_model.merged"]:
        raise InputError(other)
    return state


def doubted(tree: KinematicTree, alike: Tensor) -> KinematicTree:
    """The tree with all joints called ambiguous of parts that may have turned quite otherwise, `alike` [P]."""
    fits = [
        replace(j.fit, ambiguous=j.fit.ambiguous or bool(alike[[j.parent - 1, j.child - 1]].any())) for j in tree.joints
    ]
    return replace(tree, joints=[replace(j, fit=fit) for j, fit in zip(tree.joints, fits, strict=True)])


def other_parent_note(joint: Joint, names: Mapping[int, str]) -> str:
    """Of a joint whose child may hang on another part."""
    child, parent, other = names[joint.child], names[joint.parent], names[joint.other.parent]
    return (
        f"{child} hangs on {parent}, but may as well hang on {other}: --joint '{child}:{other}' says so, "
        f"--joint '{child}:{parent}' that it does not."
    )


def unexplained_note(joint: Joint, names: Mapping[int, str]) -> str:
    """Of a joint that leaves more of the motions than the poses' covariances explain."""
    child, parent = names[joint.child], names[joint.parent]
    return (
        f"{child}: its {joint.fit.type} joint on {parent} leaves more of the motion than the poses' errors explain; "
        "one of the two, or what lies between them, may be posed wrongly."
    )


def surface_points(splat: Splat) -> Tensor:
    """Means [N, 3] float64 of the Gaussians that say where the surface is: the opaque ones, and at least half."""
    opacities = splat.opacities
    return splat.means[opacities >= opacities.median().clamp(max=MIN_POINT_OPACITY)].double()


def splat_to_world(splat: Splat, normalization: Normalization) -> Splat:
    """A splat of the normalised world in the capture's unit."""
    out = splat.detach().scaled(1 / normalization.scale)
    out.means = out.means + torch.from_numpy(normalization.centre).to(out.means)
    return out


def covariances_to_world(covariance: Tensor, normalization: Normalization) -> Tensor:
    """Covariances [S, P, 6, 6] of left increments (translation, rotation) about the origin, in the capture's world.

    With x_normal = s (x - c), an increment (v, w) becomes (v / s - w x c, w): the rotation is about another origin.
    """
    A = torch.eye(6, dtype=torch.float64)
    A[:3, :3] /= normalization.scale
    c = torch.from_numpy(normalization.centre)
    A[:3, 3:] = torch.tensor([[0, -c[2], c[1]], [c[2], 0, -c[0]], [-c[1], c[0], 0]], dtype=torch.float64)
    return A @ covariance.double() @ A.T


def find_pose_run(runs_dir: Path, capture: Path) -> Path:
    """The latest finished splatart-pose run on the capture below a folder of runs.

    Raises:
        InputError: when there is none.
    """
    runs = finished_runs(runs_dir, capture, "splatart-pose")
    if not runs:
        raise InputError(
            f"{runs_dir} holds no finished splatart-pose run on {capture}; run "
            f"`ns-train splatart-pose --data {capture}` first, or name its --output-dir by --pipeline.runs-dir or its "
            "config.yml by --pipeline.pose-run."
        )
    CONSOLE.print(f"Poses: {runs[-1]}", markup=False, soft_wrap=True)
    return runs[-1]


def _pose_shapes(S: int, P: int) -> dict[str, tuple[int, ...]]:
    """Of what a splatart-pose run found about S states and P parts."""
    return {
        **{"_model.merged": (), "_model.poses.base": (S, P, 4, 4), "_model.covariance": (S, P, 6, 6)},
        **{"_model.held_ratio": (P, P), "_model.worlds": (S, 4, 4), "_model.alike": (P,)},
    }


@dataclass
class JointTrainerConfig(StageTrainerConfig):
    """A run without training steps: joints are fitted, the checkpoint and the bundle are written."""

    _target: type = field(default_factory=lambda: JointTrainer)
    bundle_dir: Path | None = None
    """Where the bundle goes; the run's folder `bundle` when not given."""


class JointTrainer(StageTrainer):
    """Writes what the pipeline found and, with the viewer on, shows it."""

    config: JointTrainerConfig

    def train(self) -> None:
        self.pipeline.datamanager.train_dataparser_outputs.save_dataparser_transform(
            self.base_dir / "dataparser_transforms.json"
        )
        folder = self.config.bundle_dir or self.base_dir / "bundle"
        with errors_of_saving(self.checkpoint_dir):
            save_bundle(self.pipeline.bundle, folder)
            self.save_checkpoint(self.step)
        told = [*describe(self.pipeline.bundle), f"Bundle: {folder}", f"Config: {self.base_dir / 'config.yml'}"]
        CONSOLE.print("\n".join(told), markup=False, highlight=False, soft_wrap=True)
        self._init_viewer_state()
        self.pipeline.eval()
        if not self.config.viewer.quit_on_train_completion:
            self._train_complete_viewer()
