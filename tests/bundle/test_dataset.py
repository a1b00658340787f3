import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from splatart_ns.bundle import ArticulatedSplat
from splatart_ns.bundle.dataset import Dataset, DatasetOptions
from splatart_ns.bundle.dataset_capture import write_dataset
from splatart_ns.capture.check import check_capture, require_valid
from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.images import read_depth, read_labels
from splatart_ns.errors import InputError
from splatart_ns.evaluation.ground_truth import load_ground_truth

OPTIONS = DatasetOptions(states=3, resolution=24, seed=5)


@pytest.fixture
def splat(bundle):
    for part in bundle.parts:
        part.splat.log_scales += 0.7
        part.splat.opacity_logits[:] = 8.0
    return ArticulatedSplat(bundle)


@pytest.fixture
def dataset(splat):
    return Dataset(splat, OPTIONS)


def contents(folder):
    return {f.relative_to(folder): f.read_bytes() for f in folder.rglob("*") if f.is_file()}


def test_a_sample_is_made_again_from_its_number_alone(splat, dataset):
    earlier = list(dataset.samples(6))[4]
    again = Dataset(splat, OPTIONS)[4]
    assert (again.index, again.state, again.q) == (4, 1, earlier.q)
    for name in ("rgba", "labels", "depth"):
        assert np.array_equal(getattr(again, name), getattr(earlier, name))
    other = Dataset(splat, replace(OPTIONS, seed=6))[4]
    assert other.q != again.q and not np.array_equal(other.rgba, again.rgba)


def test_there_is_no_sample_before_the_first(dataset):
    for ask in (dataset.__getitem__, dataset.camera):
        with pytest.raises(IndexError, match="-1: the images of a dataset are 0 and up"):
            ask(-1)


def test_numpys_integers_are_numbers(splat, dataset, tmp_path):
    options = DatasetOptions(states=np.uint8(3), resolution=np.int64(24), seed=np.int32(5))
    again = Dataset(splat, options)
    assert again.options == OPTIONS and json.dumps(vars(again.options))
    assert np.array_equal(again[np.int64(4)].rgba, dataset[4].rgba)
    with pytest.raises(InputError, match="--states is 2.0; give a whole number"):
        Dataset(splat, DatasetOptions(states=np.float64(2)))


def test_each_state_has_values_from_another_piece_of_the_observed_range(splat):
    states = 20
    many = Dataset(splat, DatasetOptions(states=states))
    for name, joint in splat.joints.items():
        low, high = joint.limits
        values = np.array([many.configuration(k)[name] for k in range(states)])
        assert sorted(np.floor((values - low) / (high - low) * states).astype(int)) == list(range(states))
        assert np.diff(sorted(values)).min() > 1.03 * (high - low) / states  # no two states are nearly the same
    hinge, slide = ([many.configuration(k)[name] for k in range(states)] for name in ("hinge", "slide"))
    assert abs(np.corrcoef(hinge, slide)[0, 1]) < 0.7


@pytest.mark.parametrize("seed", range(5))
def test_two_states_are_most_of_the_observed_range_apart_and_within_it(splat, seed):
    two = Dataset(splat, DatasetOptions(states=2, seed=seed))
    for name, joint in splat.joints.items():
        low, high = joint.limits
        a, b = sorted(two.configuration(k)[name] for k in (0, 1))
        assert low <= a < b <= high and b - a == pytest.approx(0.8 * (high - low))


def test_one_state_may_be_anywhere(splat):
    values = [Dataset(splat, DatasetOptions(states=1, seed=seed)).configuration(0)["hinge"] for seed in range(20)]
    low, high = splat.joints["hinge"].limits
    assert min(values) < low + 0.2 * (high - low) and max(values) > high - 0.2 * (high - low)


def test_a_round_part_whose_turns_nothing_tells_is_shown_turned(bundle):
    joint = bundle.joints[0]
    joint.type, joint.limits, joint.values = "revolute", (-np.pi, np.pi), 0 * joint.values
    turned = Dataset(ArticulatedSplat(bundle), DatasetOptions(states=8))
    values = np.array([turned.configuration(k)[joint.name] for k in range(8)])
    assert values.min() < -0.7 * np.pi and values.max() > 0.7 * np.pi


def test_no_state_is_beyond_limits_that_somebody_narrowed(bundle):
    bundle.joints[1].limits = (0.0, 0.3)
    narrowed = Dataset(ArticulatedSplat(bundle), DatasetOptions(states=20))
    values = [narrowed.configuration(k)["hinge"] for k in range(20)]
    assert 0.0 <= min(values) < 0.02 and 0.28 < max(values) <= 0.3


def test_a_joint_of_several_freedoms_stays_within_what_was_observed_of_each(bundle):
    joint = bundle.joints[0]
    joint.type, joint.limits, joint.values = "spherical", None, torch.tensor([[0.0, 0, 0], [0.3, 0, -0.2]]).double()
    several = Dataset(ArticulatedSplat(bundle), DatasetOptions(states=8))
    values = np.array([several.configuration(k)["slide"] for k in range(8)])
    assert (values.min(0) >= [0, 0, -0.2]).all() and (values.max(0) <= [0.3, 0, 0]).all()
    assert abs(np.corrcoef(values[:, 0], values[:, 2])[0, 1]) < 0.9


def test_the_views_of_a_state_lie_all_around_or_above(splat, dataset):
    def directions(views):
        cameras = [Dataset(splat, replace(OPTIONS, views=views)).camera(3 * i) for i in range(60)]
        away = np.stack([c.T_world_camera[:3, 3].numpy() for c in cameras]) - dataset.centre
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    around, above = directions("sphere"), directions("hemisphere")
    assert np.linalg.norm(around.mean(0)) < 0.1 and above[:, 2].min() > 0
    nearest = np.sort(around @ around.T, axis=1)[:, -2]
    assert np.degrees(np.arccos(nearest)).min() > 8  # of 60 evenly spread ones: about 25


def test_labels_depth_and_alpha_agree(dataset):
    for sample in dataset.samples(3):
        alpha = sample.rgba[..., 3] / 255
        assert ((sample.labels > 0) == (alpha > 0.5)).mean() > 0.97
        assert set(np.unique(sample.labels)) <= {0, 1, 2, 7} and (alpha > 0.9).any()
        assert not sample.rgba[alpha == 0].any()
        distance = np.linalg.norm(sample.camera.T_world_camera[:3, 3].numpy() - dataset.centre)
        assert (np.abs(sample.depth[alpha > 0.9] - distance) < 1.1 * dataset.radius).all()
        for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1]):
            assert edge.max() < 0.5


def test_what_is_written_is_read_as_the_same_capture(dataset, tmp_path):
    folder = tmp_path / "capture"
    assert write_dataset(dataset, folder, 8)
    capture = load_capture(folder)
    assert [len(state.frames) for state in capture.states] == [3, 3, 2] and capture.length_unit == "metre"
    assert [name for i, name in capture.parts.items() if i in (1, 2, 7)] == ["base", "door", "latch"]
    frame, sample = capture.states[1].frames[2], dataset[7]
    torch.testing.assert_close(torch.from_numpy(frame.T_world_camera), sample.camera.T_world_camera)
    torch.testing.assert_close(torch.from_numpy(frame.camera.K), sample.camera.K)
    rgba = cv2.cvtColor(cv2.imread(str(frame.image), cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA)
    assert np.array_equal(rgba, sample.rgba) and np.array_equal(read_labels(frame.labels), sample.labels)
    unit = json.loads((folder / "state_01/transforms.json").read_text())["depth_unit_scale_factor"]
    np.testing.assert_allclose(read_depth(frame.depth, unit), sample.depth, atol=0.5001 * unit)
    assert unit < 1e-3 * dataset.radius


def test_a_dataset_of_a_bundle_whose_part_ids_have_gaps_can_be_fitted(splat, tmp_path):
    folder = tmp_path / "capture"
    write_dataset(Dataset(splat, replace(OPTIONS, resolution=64)), folder, 18)
    told = [(p.severity, p.message) for p in check_capture(folder)[1] if "never labelled" in p.message]
    assert told == [("warning", f"part {i} (part_{i}) is never labelled") for i in range(3, 7)]
    assert require_valid(folder).parts[7] == "latch"


def test_the_ground_truth_is_that_of_the_bundle(dataset, splat, tmp_path):
    write_dataset(dataset, tmp_path / "capture", 3)
    truth = load_ground_truth(tmp_path / "capture")
    assert truth.parts == {1: "base", 2: "door", 7: "latch"} and truth.root == 1
    poses = [splat.link_poses(dataset.configuration(k)) for k in range(3)]
    for part, name in truth.parts.items():
        expected = torch.stack([T[name] @ poses[0][name].inverse() for T in poses])
        torch.testing.assert_close(truth.motions[part], expected)
    hinge, slide = truth.joints
    assert [(j.name, j.type, j.parent, j.child) for j in truth.joints] == [
        ("hinge", "revolute", 1, 2),
        ("slide", "prismatic", 2, 7),
    ]
    # The latch slides along x of a door that has turned by the hinge's value at state 0.
    turned = hinge.absolute_zero
    torch.testing.assert_close(slide.axis, torch.tensor([np.cos(turned), np.sin(turned), 0.0], dtype=torch.float64))
    assert float(slide.values[1]) == pytest.approx(
        dataset.configuration(1)["slide"] - dataset.configuration(0)["slide"]
    )
    assert all(len(points) > 4 for points in truth.points.values())


def test_joints_that_the_ground_truth_cannot_tell_leave_it_out(bundle, tmp_path):
    bundle.joints[1].type = "screw"
    assert not write_dataset(Dataset(ArticulatedSplat(bundle), OPTIONS), tmp_path / "capture", 3)
    assert not (tmp_path / "capture/ground_truth.json").exists()
    assert len(load_capture(tmp_path / "capture").states) == 3


def test_a_run_that_was_ended_goes_on_to_the_same_files(dataset, tmp_path):
    whole, ended = tmp_path / "whole", tmp_path / "ended"
    write_dataset(dataset, whole, 6)

    def stop(missing):
        yield from missing[:4]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(dataset, ended, 6, stop)
    assert not list(ended.rglob("transforms.json")) and len(list(ended.rglob("images/*.png"))) == 4
    made = []
    write_dataset(dataset, ended, 6, lambda missing: made.extend(missing) or missing)
    assert made == [4, 5] and contents(ended) == contents(whole)


def test_more_images_can_be_added(dataset, tmp_path):
    more, grown = tmp_path / "more", tmp_path / "grown"
    write_dataset(dataset, more, 7)
    for count in (3, 7):
        write_dataset(dataset, grown, count)
    assert contents(grown) == contents(more)


def test_a_folder_that_holds_something_else_is_refused(splat, dataset, bundle, tmp_path):
    folder = tmp_path / "capture"
    write_dataset(dataset, folder, 3)
    with pytest.raises(InputError, match="other options; give another --output"):
        write_dataset(Dataset(splat, replace(OPTIONS, seed=9)), folder, 3)
    bundle.parts[0].splat.means[0] += 1e-3
    with pytest.raises(InputError, match="another bundle"):
        write_dataset(Dataset(ArticulatedSplat(bundle), OPTIONS), folder, 3)
    bundle.parts[0].splat.means[0] -= 1e-3
    bundle.joints[0].limits = (bundle.joints[0].limits[0], bundle.joints[0].limits[1] + 0.1)
    with pytest.raises(InputError, match="another bundle"):
        write_dataset(Dataset(ArticulatedSplat(bundle), OPTIONS), folder, 3)
    shutil.copytree(folder / "state_00", tmp_path / "other/state_00")
    with pytest.raises(InputError, match="no dataset of ours"):
        write_dataset(dataset, tmp_path / "other", 3)


@pytest.mark.parametrize("name", ["x.gif", "x.MP4", "x.png"])
def test_a_dataset_is_not_called_as_a_picture_or_film(dataset, tmp_path, name):
    with pytest.raises(InputError, match=f"{name}: is called as a picture or film"):
        write_dataset(dataset, tmp_path / name, 3)
    assert contents(tmp_path) == {}


@pytest.mark.parametrize("options", [{"states": 0}, {"states": 2.5}, {"resolution": 7}, {"views": "top"}, {"seed": -1}])
def test_options_that_make_no_sense_are_refused(splat, options):
    with pytest.raises(InputError, match=f"--{next(iter(options))} is"):
        Dataset(splat, DatasetOptions(**options))


def test_fewer_images_than_states_are_refused(dataset, tmp_path):
    with pytest.raises(InputError, match="--dataset is 2; give at least an image for each of the 3 --states"):
        write_dataset(dataset, tmp_path / "capture", 2)
    assert not (tmp_path / "capture").exists()


def test_fewer_images_than_there_are_would_leave_some_behind(dataset, tmp_path):
    write_dataset(dataset, tmp_path / "capture", 6)
    before = contents(tmp_path / "capture")
    with pytest.raises(InputError, match="holds 6 images, more than --dataset 3"):
        write_dataset(dataset, tmp_path / "capture", 3)
    assert contents(tmp_path / "capture") == before


def test_a_part_without_gaussians_has_no_geometry(bundle, tmp_path):
    bundle.parts[2].splat = bundle.parts[2].splat.select(torch.tensor([], dtype=torch.long))
    write_dataset(Dataset(ArticulatedSplat(bundle), OPTIONS), tmp_path / "capture", 3)
    truth = load_ground_truth(tmp_path / "capture")
    assert list(truth.parts.values()) == [part.name for part in bundle.parts[:2]] and len(truth.points) == 2
