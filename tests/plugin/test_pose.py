import copy
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from nerfstudio.engine.trainer import Trainer

from splatart_ns.capture.check import require_valid
from splatart_ns.capture.formats import load_capture
from splatart_ns.errors import InputError
from splatart_ns.geometry.se3 import inverse, se3_exp, so3_log, transform_points
from splatart_ns.method_configs.pose import method as pose_method
from splatart_ns.plugin.pose import MOST, RATES, THINNING_PARTS
from splatart_ns.plugin.semantic_run import read_state
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.thinning import BUDGET, LARGEST_SHARE, ROUNDS, absences
from splatart_ns.stages.world import WorldFit


@pytest.fixture(scope="module")
def semantic_runs(capture_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """A short splatart-semantic run of each state."""
    from splatart_ns.method_configs.semantic import method as semantic_method

    runs = []
    for state in (0, 1):
        config = copy.deepcopy(semantic_method.config)
        config.output_dir, config.vis, config.timestamp = tmp_path_factory.mktemp("runs"), "tensorboard", "run"
        config.logging.local_writer.enable = False
        config.data = config.pipeline.datamanager.data = capture_dir
        config.pipeline.datamanager.dataparser.state = state
        config.max_num_iterations, config.pipeline.model.semantic_start = 66, 60
        config.pipeline.datamanager.seed_gaussians = 400
        torch.manual_seed(0)
        config.save_config()
        config.machine.device_type = "cpu"  # what tests compare with lies there
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        trainer.train()
        runs.append(config.get_base_dir() / "config.yml")
    return tuple(runs)


@pytest.fixture
def pose_trainer(capture_dir, semantic_runs, tmp_path):
    """Makes a Trainer of splatart-pose that is set up and has not begun."""

    def make(steps: int = 6, pose_steps: int = 4, **pipeline) -> Trainer:
        config = copy.deepcopy(pose_method.config)
        config.output_dir, config.vis, config.timestamp = tmp_path, "tensorboard", "run"
        config.logging.local_writer.enable = False
        config.data = config.pipeline.datamanager.data = capture_dir
        config.pipeline.semantic_runs = semantic_runs
        config.pipeline.model.learn_gaussians = pipeline.pop("learn_gaussians", "after")
        config.pipeline.datamanager.dataparser.worlds = pipeline.pop("worlds", None)
        for name, value in pipeline.items():
            setattr(config.pipeline, name, value)
        config.max_num_iterations, config.pipeline.model.pose_steps = steps, pose_steps
        config.machine.device_type = "cpu"  # what tests compare with lies there
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        return trainer

    return make


def test_a_root_that_is_no_part_and_options_of_training_on_images_are_told(pose_trainer, monkeypatch):
    with pytest.raises(InputError, match="has no part 'door'; choose --pipeline.root from base, lid"):
        pose_trainer(root="door")
    monkeypatch.setattr(pose_method.config.pipeline.model, "ssim_lambda", 0.3)
    with pytest.raises(InputError, match="ssim-lambda is 0.3, but splatart-pose does not read it"):
        pose_trainer()


def test_poses_start_at_centroids(pose_trainer):
    T = pose_trainer(init="centroids").pipeline.model.poses.T().detach()
    assert torch.equal(T[..., :3, :3], torch.eye(3).double().expand(2, 2, 3, 3))
    assert T[1, 1, :3, 3].norm() > 0.2 and T[1, 0, :3, 3].norm() < 0.1


def test_poses_start_from_a_file_in_the_captures_unit(pose_trainer, capture_dir, tmp_path):
    capture = require_valid(capture_dir)
    eye = torch.eye(4)
    moved = eye.clone()
    moved[0, 3] = 0.25
    parts = [{"name": name, "motion": [eye.tolist(), moved.tolist()]} for name in capture.parts.values()]
    (tmp_path / "motions.json").write_text(json.dumps({"parts": parts}))
    model = pose_trainer(init="file", init_file=tmp_path / "motions.json").pipeline.model
    assert torch.allclose(model.poses.T()[1, :, 0, 3], torch.tensor(0.25 * capture.normalization.scale).double())


def test_gaussians_that_no_view_shows_are_left_out(pose_trainer, monkeypatch):
    def last_seen(splat, views):
        seen = (torch.arange(len(splat)) == len(splat) - 1).float()
        return seen, seen

    monkeypatch.setattr("splatart_ns.plugin.pose.looked_at", last_seen)
    model = pose_trainer(init="centroids").pipeline.model
    assert [len(model.state_splat(state)) for state in (0, 1)] == [1, 1]


def test_poses_look_at_the_labels_that_the_splats_show_and_gaussians_learn_only_given_ones(pose_trainer, capture_dir):
    pipeline = pose_trainer(init="centroids").pipeline
    names = [
        {frame.name for frame in state.split("train") if frame.labels is not None}
        for state in require_valid(capture_dir).states
    ]
    assert all(0 < len(of_state) < 10 for of_state in names)
    assert all(view.labels is not None for views in pipeline.views for view in views)
    learned = [next(pipeline._own)[:2] for _ in range(20)]
    aims = [next(pipeline._pairs)[1:] for _ in range(20)]
    assert all((view.labels is not None) == (view.name in names[s]) for s, view in (*learned, *aims))


def test_a_part_in_doubt_is_sought_along_the_ways_of_sure_slides(pose_trainer, monkeypatch):
    slide, over, better = (torch.eye(4).double() for _ in range(3))
    slide[1, 3], over[2, 3], better[1, 3] = 0.3, 0.5, 0.2
    sought = []

    def initial(splats, views, seen, part, seed):
        return InitialMotion(*((slide, True) if part == 1 else (over, True)), alike=() if part == 1 else (slide,))

    def along(splats, views, part, motion, ways):
        sought.append((part, ways.tolist()))
        return InitialMotion(better, found=True)

    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", initial)
    monkeypatch.setattr("splatart_ns.plugin.pose.slid_alike", along)
    model = pose_trainer().pipeline.model
    assert sought == [(2, [[0.0, 1.0, 0.0]])]
    assert torch.equal(model.poses.T()[1], torch.stack([slide, better]))
    assert not any(model.alike)


def test_parts_move_as_what_they_touch_lets_them(pose_trainer, monkeypatch):
    found, better = (InitialMotion(torch.eye(4).double(), found=True) for _ in range(2))
    better.T[2, 3] = 0.2
    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", lambda *_: found)
    monkeypatch.setattr(
        "splatart_ns.plugin.pose.turned_as_neighbours_let", lambda splats, views, motions: {**motions, 2: better}
    )
    assert torch.equal(pose_trainer().pipeline.model.poses.T()[1], torch.stack([found.T, better.T]))


@pytest.mark.parametrize("worlds", ["shared", "rigid"])
def test_only_in_one_world_is_what_looks_still_held_still(pose_trainer, monkeypatch, worlds):
    still = InitialMotion(torch.eye(4).double(), found=True, still=True)
    world = WorldFit(torch.eye(4).double(), torch.zeros(7, 7).double(), 1.0)
    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", lambda *_: still)
    monkeypatch.setattr("splatart_ns.plugin.pose.fit_worlds", lambda *_: (1, [world]))
    # The runs are of one world.
    monkeypatch.setattr("splatart_ns.plugin.dataparser.focus_on_focus", lambda *said: replace(said[0], worlds=said[1]))
    pipeline = pose_trainer(worlds=worlds).pipeline
    assert pipeline._frozen[1].tolist() == [worlds == "shared"] * 2


@pytest.mark.parametrize("root", [None, "base"])
def test_worlds_are_brought_together_by_the_part_that_rests_among_surroundings(pose_trainer, monkeypatch, root):
    world, moved = (se3_exp(torch.tensor(x).double()) for x in ([1.0, 0, 0, 0, 0, 0.8], [0, 0.5, 0, 0.6, 0, 0]))
    tried, asked = [], []

    def fit(splats, views, seen, parts, *_):
        tried.append(list(parts))
        return 1, [WorldFit(world, torch.zeros(7, 7).double(), 1.0)]

    def refine(splats, views, part, start, with_scale):
        tried.append(part)
        return WorldFit(start, torch.zeros(7, 7).double(), 1.0)

    def rests(around, motions, known, points, parts):
        asked.append(list(parts))
        return 2

    monkeypatch.setattr("splatart_ns.plugin.pose.fit_worlds", fit)
    monkeypatch.setattr("splatart_ns.plugin.pose.refine_world", refine)
    monkeypatch.setattr("splatart_ns.plugin.pose.resting_part", rests)
    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", lambda *_: InitialMotion(moved, found=True))
    monkeypatch.setattr("splatart_ns.plugin.dataparser.focus_on_focus", lambda *said: replace(said[0], worlds=said[1]))
    pipeline = pose_trainer(worlds="rigid", root=root).pipeline
    assert (tried, asked) == (([[1]], []) if root else ([[1, 2], 2], [[1, 2]]))
    (told,) = pipeline.findings["worlds"]
    assert told["part"] == ("base" if root else "lid") and len(pipeline.notes) == 1
    there = world if root else inverse(moved) @ world
    expected = pipeline.datamanager.capture.normalization.motion_to_world(there.numpy())
    assert torch.allclose(pipeline.model.worlds[1], torch.from_numpy(expected))


def test_a_state_is_brought_to_state_0_from_where_it_was_placed(pose_trainer, monkeypatch):
    placed, brought = (se3_exp(torch.tensor(x).double()) for x in ([1.0, 0, 0, 0, 0, 0.8], [0, 0.5, 0, 0.6, 0, 0]))

    def beside(capture, worlds):
        first, second = capture.states
        return replace(capture, worlds=worlds, states=[first, replace(second, placement=placed.numpy())])

    monkeypatch.setattr("splatart_ns.plugin.dataparser.focus_on_focus", beside)
    world = WorldFit(brought, torch.zeros(7, 7).double(), 1.0)
    monkeypatch.setattr("splatart_ns.plugin.pose.fit_worlds", lambda *_: (1, [world]))
    pipeline = pose_trainer(init="centroids", worlds="rigid").pipeline
    normalization, x = pipeline.datamanager.capture.normalization, torch.tensor([0.3, -0.2, 0.5]).double()
    scale, centre = normalization.scale, torch.from_numpy(normalization.centre)
    normal = scale * (placed[:3, :3] @ x + placed[:3, 3] - centre)
    expected = (brought[:3, :3] @ normal + brought[:3, 3]) / scale + centre
    assert torch.allclose(transform_points(pipeline.model.worlds[1], x[None])[0], expected)


def test_semantic_runs_that_are_not_one_of_each_state_in_order_are_refused(pose_trainer, semantic_runs):
    first, second = semantic_runs
    for runs, told in {
        (second, first): f"{second} is given for state_00 and was trained on state_01",
        (first, first): f"{first} is given for state_01 and was trained on state_00",
        (first,): "names 1 of the runs of .* which has 2 states",
        (first, second, second): "names 3 of the runs of .* which has 2 states",
    }.items():
        with pytest.raises(InputError, match=told):
            pose_trainer(init="centroids", semantic_runs=runs)


def move_a_camera(state: Path, meta: dict) -> None:
    next(f for f in meta["frames"] if f["file_path"] in meta["train_filenames"])["transform_matrix"][0][3] += 0.01


def exchange_an_image(state: Path, meta: dict) -> None:
    first, second = (state / name for name in meta["train_filenames"][:2])
    first.write_bytes(second.read_bytes())


def split_otherwise(state: Path, meta: dict) -> None:
    meta["train_filenames"][0], meta["test_filenames"][0] = meta["test_filenames"][0], meta["train_filenames"][0]


def zoom(state: Path, meta: dict) -> None:
    meta["fl_x"] *= 1.01


@pytest.mark.parametrize("change", [move_a_camera, exchange_an_image, split_otherwise, zoom])
@pytest.mark.parametrize("changed", ["state_00", "state_01"])
def test_a_semantic_run_of_what_a_capture_was_before_is_refused(capture_dir, semantic_runs, tmp_path, change, changed):
    capture = shutil.copytree(capture_dir, tmp_path / "capture")
    file = capture / changed / "transforms.json"
    meta = json.loads(file.read_text())
    change(file.parent, meta)
    file.write_text(json.dumps(meta))
    with pytest.raises(InputError, match="was trained on other frames, cameras .* splatart-capture --state"):
        for state, run in enumerate(semantic_runs):
            read_state(load_capture(capture), state, run, 2, "cpu")


def test_a_semantic_run_of_a_capture_that_has_moved_is_read(capture_dir, semantic_runs, tmp_path):
    capture = load_capture(shutil.copytree(capture_dir, tmp_path / "elsewhere"))
    read = read_state(capture, 1, semantic_runs[1], 2, "cpu")
    assert [view.name for view in read.views] == [frame.name for frame in capture.states[1].split("train")]


def test_a_semantic_run_of_an_earlier_version_is_refused(capture_dir, semantic_runs, tmp_path):
    run = shutil.copytree(semantic_runs[0].parent, tmp_path / "run")
    (file,) = run.glob("nerfstudio_models/*.ckpt")
    checkpoint = torch.load(file)
    del checkpoint["pipeline"]["_model.trained_on"]
    torch.save(checkpoint, file)
    with pytest.raises(InputError, match="has no '_model.trained_on' .* train that stage again"):
        read_state(load_capture(capture_dir), 0, run / "config.yml", 2, "cpu")


def test_a_missing_file_is_named(pose_trainer):
    with pytest.raises(InputError, match="init-file"):
        pose_trainer(init="file")


@pytest.mark.parametrize("learn", ["after", "along"])
def test_gaussians_wait_for_the_poses_or_learn_along(pose_trainer, learn):
    trainer = pose_trainer(init="centroids", learn_gaussians=learn)
    model = trainer.pipeline.model
    colours, poses = model.features_dc.detach().clone(), model.poses.T().detach().clone()
    seen = {}

    def note(step, **_):
        if step == 3:
            seen["colours"], seen["poses"] = model.features_dc.detach().clone(), model.poses.T().detach().clone()

    train_iteration = trainer.train_iteration

    def noted(step):
        result = train_iteration(step)
        note(step)
        return result

    trainer.train_iteration = noted
    trainer.train()
    assert not torch.equal(seen["poses"], poses)
    assert torch.equal(seen["colours"], colours) == (learn == "after")
    assert model.merged and model.poses.rotation.abs().max() == 0
    assert torch.isfinite(model.covariance).all()


def test_merged_gaussians_that_the_images_hardly_miss_go_and_the_report_tells(pose_trainer, monkeypatch):
    def known(splats, views, T, *_):
        covariance = torch.zeros(*T.shape[:2], 6, 6, dtype=torch.float64)
        return T, covariance, torch.full((2, 2), torch.nan), torch.zeros(T.shape[:2]) > 0

    monkeypatch.setattr("splatart_ns.plugin.pose.refine_known_poses", known)
    trainer = pose_trainer(steps=6, pose_steps=0, init="centroids")
    trainer.train()
    model, told = trainer.pipeline.model, trainer.pipeline.findings["thinned"]
    before, after = told["gaussians"]
    assert after == model.num_points == len(model.state_ids)
    assert (1 - LARGEST_SHARE) ** ROUNDS * before <= after < 0.95 * before
    assert 0 < told["added_error"] <= BUDGET and told["seconds"] > 0
    assert set(model.splat.part_ids.tolist()) == {1, 2}
    for name, parameter in model.gauss_params.items():
        (trained,) = trainer.optimizers.optimizers[name].param_groups[0]["params"]
        assert trained is parameter and len(parameter) == after


def test_veils_go_first_and_take_nothing_of_the_budget(pose_trainer, monkeypatch):
    trainer = pose_trainer(init="centroids")
    pipeline, few = trainer.pipeline, 20
    found = pipeline._absences(0)
    missed_most = torch.zeros_like(found.images, dtype=torch.bool)
    missed_most[found.images.argsort()[-few:]] = True
    monkeypatch.setattr("splatart_ns.plugin.pose.veils", lambda *_: missed_most)
    monkeypatch.setattr("splatart_ns.plugin.pose.strays", lambda splat, *_: torch.zeros(len(splat), dtype=torch.bool))
    kept = pipeline.model.means.detach()[~missed_most]
    pipeline._thin(0, trainer.optimizers)
    told = pipeline.findings["thinned"]
    assert told["veils"] == few and 0 < told["added_error"] <= BUDGET / ROUNDS
    left = {tuple(x) for x in pipeline.model.means.tolist()}
    assert left < {tuple(x) for x in kept.tolist()}


def test_states_and_rounds_are_looked_at_with_random_signs_of_their_own(pose_trainer, monkeypatch):
    seeds = []

    def look(splat, views, seed):
        seeds.append(seed)
        return absences(splat, views, seed)

    monkeypatch.setattr("splatart_ns.plugin.pose.absences", look)
    pipeline = pose_trainer(init="centroids").pipeline
    for turn in range(ROUNDS):
        pipeline._absences(turn)
    assert len(set(seeds)) == len(seeds) == 2 * ROUNDS


def test_strays_go_in_every_round_and_in_the_end(pose_trainer, monkeypatch):
    def first(splat, *_):
        return torch.arange(len(splat)) == 0

    monkeypatch.setattr("splatart_ns.plugin.pose.strays", first)
    trainer = pose_trainer(steps=THINNING_PARTS, pose_steps=0, init="centroids")
    trainer.train()
    told = trainer.pipeline.findings["thinned"]
    assert told["strays"] == ROUNDS + 1
    assert told["gaussians"][1] == trainer.pipeline.model.num_points == len(trainer.pipeline.model.state_ids)


@pytest.mark.parametrize(
    ("borders", "deviation", "turning", "frozen", "shifts", "turns"),
    [
        ((0.8, 0.4), 0.001, True, False, True, True),
        ((0.4, 0.8), 0.001, True, False, True, True),
        ((0.8, 0.4), 0.001, False, False, True, False),
        ((0.8, 0.4), 0.001, True, True, False, False),
        ((0.8, 0.4), 0.1, True, False, False, False),
        ((0.8, 0.75), 0.001, True, False, False, False),  # as a link of a robot
        ((0.4, 0.1), 0.001, True, False, False, False),
    ],
)
def test_well_known_poses_of_parts_set_free_from_others_learn_with_merged_gaussians(
    pose_trainer, monkeypatch, borders, deviation, turning, frozen, shifts, turns
):
    """By no more than their own, falling rate lets them, nor than three of their deviations; a slide's rotation counts
    as known."""
    found = {}

    def known(splats, views, T, *_):
        found["T"] = T.clone()
        variances = torch.tensor([1.0, 1, 1, turning, turning, turning], dtype=torch.float64) * (0.1 * deviation) ** 2
        covariance = variances.diag().repeat(*T.shape[:2], 1, 1)
        return T, covariance, torch.full((2, 2), torch.nan), torch.zeros(T.shape[:2]) > 0

    monkeypatch.setattr("splatart_ns.plugin.pose.refine_known_poses", known)
    trainer = pose_trainer(steps=6, pose_steps=0, init="centroids")
    shut = trainer.pipeline.views[0]
    monkeypatch.setattr(
        "splatart_ns.plugin.pose.border_against_others",
        lambda views, part: borders[0 if views is shut else 1] if part == 2 else 0.0,
    )
    trainer.pipeline._frozen[1, 1] = frozen
    trainer.train()
    poses = trainer.pipeline.model.poses
    assert torch.equal(poses.base[:, 0], found["T"][:, 0])
    change = poses.base[1, 1] @ found["T"][1, 1].inverse()
    assert (not torch.equal(poses.base[1, 1], found["T"][1, 1])) == shifts
    assert (not torch.allclose(change[:3, :3], torch.eye(3).double(), atol=1e-9)) == turns
    assert torch.allclose(change[:3, :3], torch.eye(3).double(), atol=0.003)
    assert so3_log(change[:3, :3]).norm() < 1.01 * MOST * 0.1 * deviation
    assert not poses.rotation.any() and not poses.translation.any()
    assert trainer.optimizers.optimizers["part_poses"].param_groups[0]["lr"] < 0.1 * RATES[0]


def test_what_a_state_does_not_show_is_not_missed_there(pose_trainer):
    pipeline = pose_trainer(init="centroids").pipeline
    model = pipeline.model
    whole = pipeline._absences(0).images
    model.covariance[1, 1] = torch.nan
    absence = pipeline._absences(0).images
    lid = model.splat.part_ids == 2
    assert absence[lid].sum() < whole[lid].sum() and absence[lid].any()


def test_a_part_is_not_shown_in_a_state_where_its_pose_is_not_known(pose_trainer):
    pipeline = pose_trainer(init="centroids").pipeline
    model, known = pipeline.model, torch.tensor([[True, False], [True, True]])
    model.covariance[~known] = torch.nan
    shown = [set(model.splat_at(state, model.poses.T()).part_ids.tolist()) for state in (0, 1)]
    assert shown == [{1}, {1, 2}]


def test_what_the_images_leave_open_is_noted_and_puts_parts_in_doubt(pose_trainer, monkeypatch):
    def initial(splats, views, seen, part, seed):
        rests = InitialMotion(torch.eye(4).double(), found=True, still=True)
        return replace(rests, maybe_moved=True) if part == 1 else replace(rests, found=False)

    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", initial)
    monkeypatch.setattr("splatart_ns.plugin.pose.turned_as_neighbours_let", lambda splats, views, motions: motions)
    trainer = pose_trainer(steps=6, pose_steps=0)
    trainer.train()
    unknown, rests = trainer.pipeline.notes
    assert unknown.startswith("part lid, state 1: the images show too little")
    assert rests.startswith("part base, state 1: seems to rest")
    assert trainer.pipeline.model.alike.tolist() == [True, False]


@pytest.mark.parametrize("moves_elsewhere", [False, True])
def test_a_part_that_only_seems_to_rest_is_not_held_where_another_state_shows_that_it_moves(
    pose_trainer, monkeypatch, moves_elsewhere
):
    pipeline = pose_trainer(init="centroids").pipeline
    splats = [pipeline.model.state_splat(0), pipeline.model.state_splat(1), pipeline.model.state_splat(1)]
    rests = InitialMotion(torch.eye(4).double(), found=True, still=True)
    turned = InitialMotion(se3_exp(torch.tensor([0, 0, 0, 0, 0, 0.5]).double()), found=True)

    def motion(pair, views, seen, part, seed):
        if pair[1] is splats[2] and part == 2:
            return replace(rests, maybe_moved=True)
        return turned if moves_elsewhere and part == 2 else rests

    monkeypatch.setattr("splatart_ns.plugin.pose.initial_motion", motion)
    pipeline.config.init = "registration"
    pipeline.views = [*pipeline.views, pipeline.views[1]]
    pipeline._seen = [torch.ones(len(splat)) for splat in splats]
    pipeline._known, pipeline._frozen, pipeline._maybe_moved = (
        torch.full((3, 2), known) for known in (True, False, False)
    )
    pipeline._initial_poses(splats)
    assert pipeline._frozen[2].tolist() == [True, not moves_elsewhere]
    assert pipeline._frozen[1].tolist() == [True, not moves_elsewhere]


def test_a_run_that_would_never_merge_is_refused(pose_trainer):
    with pytest.raises(InputError, match="max-num-iterations"):
        pose_trainer(steps=4, pose_steps=4, init="centroids")
    with pytest.raises(InputError, match="pose-steps is -1; give 0 or more"):
        pose_trainer(pose_steps=-1, init="centroids")


def test_a_seed_that_is_none_is_refused(pose_trainer):
    with pytest.raises(InputError, match="--pipeline.seed is -1"):
        pose_trainer(seed=-1)


def test_merged_gaussians_learn_from_the_pieces_that_show_the_object(pose_trainer):
    pipeline = pose_trainer(init="centroids").pipeline
    views = [view for of_state in pipeline.views for view in of_state]
    for view in views:  # a corner of the object is all that is left of it
        view.alpha = view.alpha.clone()
        view.alpha[24:] = view.alpha[:, 24:] = 0
        view.alpha[0, 0] = 255
    own = pipeline._shuffled_views(pipeline.views)
    for state, piece, share in (next(own) for _ in views):
        whole = next(view for view in pipeline.views[state] if view.name == piece.name)
        assert piece.alpha.sum() == whole.alpha.sum()
        assert share == piece.width * piece.height / (whole.width * whole.height) < 1
    far = replace(piece, depth=torch.full(piece.alpha.shape, 50.0))
    pipeline._own = iter([(state, piece, share), (state, piece, 0.5 * share), (state, far, share)])
    pipeline.model.merged.fill_(True)
    first, second, third = (pipeline.get_train_loss_dict(step)[1] for step in (0, 0, 0))
    assert float(sum(second.values())) < 0.9 * float(sum(first.values()))
    assert "depth" not in first and float(third["depth"]) > 0.5 * share  # they are two or three away


def test_parts_that_are_far_from_a_states_images_are_told_and_all_in_doubt(pose_trainer):
    trainer = pose_trainer()
    trainer.train()
    pipeline, model = trainer.pipeline, trainer.pipeline.model
    before = pipeline.findings["images"][1]
    assert before["state"] == "state_01" and before["psnr"] > 15
    assert not any("differ" in note for note in pipeline.notes)
    model.poses.base[1, :, :3, 3] += 0.5
    model.alike[:] = False
    pipeline.notes.clear()
    pipeline._tell_errors()
    (note,) = pipeline.notes
    assert note.startswith("state_01: the posed parts differ from its images ")
    assert model.alike.all() and pipeline.findings["images"][1]["psnr"] < before["psnr"] - 3
