from dataclasses import replace

import torch
from part_scene import box, photograph

from splatart_ns.geometry.se3 import se3_exp
from splatart_ns.splats.splat import Splat
from splatart_ns.stages import hull
from splatart_ns.stages.hull import (
    EXACT,
    MIN_POINTS_PER_PART,
    POINTS_PER_PART,
    POINTS_PER_PIXEL,
    inside_silhouettes,
    likely_parts,
    seed_points,
    seen_surface,
    slack,
    surface,
    visual_hull,
)

SIZE = (0.9, 0.6, 0.3)
BASE, KNOB = box(1, SIZE, (0.0, 0.0, -0.1)), box(2, (0.16, 0.16, 0.16), (0.0, 0.0, 0.3), spacing=0.04)
VIEWS = photograph(Splat.cat([BASE, KNOB]), count=14)
HULL = visual_hull(VIEWS)


def started(views, count, voxels, seed: int = 0):
    return seed_points(views, 2, count, torch.Generator().manual_seed(seed), voxels, seen_surface(views, *voxels))


def seeds(seed: int = 0):
    return started(VIEWS, 500, HULL, seed)


def test_the_hull_holds_the_object_and_little_more():
    voxels, size = HULL
    inside = (voxels - torch.tensor([0.0, 0.0, -0.1])).abs() <= torch.tensor(SIZE) / 2 - 2 * size
    box_volume = SIZE[0] * SIZE[1] * SIZE[2]
    assert inside.all(-1).any()
    assert 0.8 * box_volume < len(voxels) * size**3 < 3.5 * box_volume  # the images are small
    assert (voxels.norm(dim=-1) < 0.9).all()


def test_a_rod_thinner_than_the_voxels_does_not_fall_between_their_centres():
    rod = box(1, (0.8, 0.02, 0.02), (0.0, 0.0, 0.0), spacing=0.02)
    voxels, size = visual_hull(photograph(rod, 14, 160))
    assert torch.cdist(rod.means, voxels).amin(1).max() < size


def test_what_no_view_sees_or_one_view_sees_through_is_carved():
    points = torch.tensor([[0.0, 0.0, -0.1], [0.0, 0.6, 0.0], [0.0, 0.0, 50.0]])
    assert inside_silhouettes(VIEWS, points, 0).tolist() == [True, False, False]


def test_beyond_the_border_of_a_whole_view_is_outside_and_of_a_cut_view_unknown():
    beyond = torch.tensor([[0.0, 0.0, 5.0]])
    view = VIEWS[len(VIEWS) // 2]  # from the side
    cut = view.to("cpu")
    cut.alpha = torch.full_like(view.alpha, 255)
    centre = torch.zeros(1, 3)
    assert not inside_silhouettes([view], beyond, 0).any()
    assert inside_silhouettes([cut], centre, 0).all()
    assert not inside_silhouettes([cut], beyond, 0).any()  # never seen at all
    assert inside_silhouettes([cut, *VIEWS], torch.tensor([[0.0, 0.0, -0.1]]), 0).all()


def test_points_take_the_label_that_most_views_show():
    points = torch.tensor([[0.0, 0.0, 0.3], [0.4, 0.25, -0.2]])
    labels, share = likely_parts(VIEWS, points, 0.05, 2)
    assert labels.tolist() == [2, 1]
    assert share[1] == 1.0 and 0.5 < share[0] < 1.0  # from below the base is before the knob
    silent = [replace(view, labels=None) for view in VIEWS]
    labels, share = likely_parts(silent, points, 0.05, 2)
    assert labels.tolist() == share.tolist() == [0, 0]


def test_a_small_part_gets_its_least_number_of_points():
    labels, _ = likely_parts(VIEWS, seeds().xyz, 0.03, 2)  # of 500 points, 250 each: it has a fortieth of the volume
    assert (labels == 2).sum() > 0.8 * 250
    fine = photograph(Splat.cat([BASE, KNOB]), count=6, pixels=240)
    points = started(fine, 4000, visual_hull(fine))
    labels, _ = likely_parts(fine, points.xyz, 0.03, 2)
    assert 0.8 * MIN_POINTS_PER_PART[2] < (labels == 2).sum() < 1.5 * MIN_POINTS_PER_PART[2]


def test_a_small_part_that_half_of_the_views_see_nothing_of_gets_points_by_its_pixels():
    button = box(2, (0.12, 0.12, 0.04), (0.1, 0.0, 0.07), spacing=0.02)
    views = photograph(Splat.cat([BASE, button]), count=14, pixels=160)
    points = started(views, 4000, visual_hull(views))
    above = ((points.xyz[:, :2] - torch.tensor([0.1, 0.0])).abs() < 0.1).all(-1) & (points.xyz[:, 2] > 0.06)
    most = max(int((view.labels == 2).sum()) for view in views)
    assert 4 * most < above.sum() < 8 * most


def test_a_small_part_gets_its_points_where_the_views_agree(monkeypatch):
    def left_is_more_sure(views, points, size, num_parts):
        return torch.where(points[:, 2] > 0.2, 2, 1), torch.where(points[:, 0] < 0, 0.9, 0.3)

    monkeypatch.setattr(hull, "likely_parts", left_is_more_sure)
    knob = (xyz := seeds().xyz)[xyz[:, 2] > 0.2]
    assert (knob[:, 0] < 0.02).float().mean() > 0.9


def test_the_outermost_voxels_lack_a_neighbour():
    cube = torch.cartesian_prod(*[torch.arange(5)] * 3)
    full = surface(0.1 * cube.float() + 0.37, 0.1)
    assert len(full) == 5**3 - 3**3 and (cube[full] % 4 == 0).any(1).all()
    hollow = cube[(cube != 2).any(1)]
    assert len(surface(0.1 * hollow.float() + 0.37, 0.1)) == 5**3 - 3**3 + 6
    assert surface(torch.zeros(1, 3), 0.1).tolist() == [0]


def test_where_stereo_finds_nothing_half_of_the_points_start_on_the_hulls_surface_and_half_anywhere():
    voxels, size = HULL
    # Plain, and no part is filled up.
    silent = [replace(view, rgb=torch.full_like(view.rgb, 99), labels=None) for view in VIEWS]
    points = started(silent, 3000, (voxels, size)).xyz
    outer = surface(voxels, size)
    inner = torch.ones(len(voxels), dtype=torch.bool)
    inner[outer] = False
    on_surface = ~inner[torch.cdist(points, voxels).argmin(1)]
    share = len(outer) / len(voxels)
    assert abs(float(on_surface.float().mean()) - (0.5 + 0.5 * share)) < 0.05


def test_small_silhouettes_get_fewer_points():
    pixels = sum(float((view.alpha > 127).sum()) for view in VIEWS) / len(VIEWS)
    points = [started(VIEWS, n, HULL) for n in (20000, 40000)]
    assert len(points[0].xyz) == len(points[1].xyz)
    enough = POINTS_PER_PIXEL * pixels + POINTS_PER_PART * 2
    assert enough - 1 < len(points[0].xyz) < 2 * enough  # and the small part's
    far = photograph(Splat.cat([BASE, KNOB]), count=14, pixels=24)
    less = started(far, 20000, HULL)
    assert len(less.xyz) < 0.7 * len(points[0].xyz)


def test_points_have_the_colours_of_the_images_and_repeat_by_seed():
    first, again, other = seeds(), seeds(), seeds(1)
    assert torch.equal(first.xyz, again.xyz) and not torch.equal(first.xyz, other.xyz)
    assert first.rgb.shape == first.xyz.shape
    assert 0 <= first.rgb.min() and first.rgb.max() <= 255 and first.rgb.std() > 5


def test_no_silhouette_gives_no_hull():
    empty = [view.to("cpu") for view in VIEWS]
    for view in empty:
        view.alpha = torch.zeros_like(view.alpha)
    assert visual_hull(empty) is None


def test_silhouettes_of_wrong_cameras_have_slack():
    splat = box(1, (0.8, 0.12, 0.12), (0.0, 0.0, 0.0))
    views = photograph(splat, 12)
    found, hull = slack(views)
    assert found == EXACT
    assert torch.equal(hull[0], visual_hull(views)[0])
    g = torch.Generator().manual_seed(0)
    wrong = [replace(v, viewmat=se3_exp(0.02 * torch.randn(6, generator=g)) @ v.viewmat) for v in views]
    found, _ = slack(wrong)
    assert found.pixels > 0
    few, many = visual_hull(wrong), visual_hull(wrong, slack=found)
    assert few is None or len(few[0]) < len(many[0])


def test_of_many_views_one_that_loses_a_plate_from_its_edge_is_no_slack_of_the_cameras():
    views = photograph(box(1, (0.8, 0.12, 0.12), (0.0, 0.0, 0.0)), 30)
    lost = [*views[1:], replace(views[0], alpha=views[0].alpha.clone())]
    lost[-1].alpha[:, : lost[-1].width // 2] = 0
    found, hull = slack(lost)
    assert (found.pixels, found.views) == (0, 1)
    without, _ = visual_hull(lost)
    assert float(hull[0][:, 0].min()) < -0.45 < -0.3 < float(without[:, 0].min())
    inside = inside_silhouettes(lost, hull[0], dilate=1, erring=1)
    assert inside.all() and not inside_silhouettes(lost, hull[0], dilate=1).all()
    assert slack(lost[-12:])[0].pixels > 0


def test_where_a_view_may_err_what_is_a_quarter_covered_counts():
    faint = [replace(view, alpha=view.alpha // 4) for view in VIEWS]
    centre = torch.tensor([[0.0, 0.0, -0.1]])
    assert inside_silhouettes(faint, centre, 0, erring=1).all() and not inside_silhouettes(faint, centre, 0).any()


def test_views_that_may_err_do_not_hide_that_cameras_are_a_little_off():
    g = torch.Generator().manual_seed(0)
    views = photograph(box(1, (0.8, 0.12, 0.12), (0.0, 0.0, 0.0)), 30)
    wrong = [replace(v, viewmat=se3_exp(0.006 * torch.randn(6, generator=g)) @ v.viewmat) for v in views]
    assert slack(wrong)[0].pixels > 0


def test_what_a_mask_leaves_out_carves_nothing_and_need_not_be_filled():
    masked = list(VIEWS)
    left = torch.arange(VIEWS[0].width).expand(VIEWS[0].height, -1) < VIEWS[0].width // 2
    masked[3] = replace(VIEWS[3], alpha=VIEWS[3].alpha.where(left, 0), mask=left)
    found, _ = slack(masked)
    assert found == EXACT
    whole, carved, left_out = (
        len(voxels) * size**3
        for voxels, size in map(visual_hull, (VIEWS, [replace(view, mask=None) for view in masked], masked))
    )
    assert carved < 0.8 * whole < 0.98 * whole < left_out < 1.1 * whole
    # Nor is a hand looked for that the silhouette has for the object.
    hand = list(VIEWS)
    hand[3] = replace(VIEWS[3], alpha=VIEWS[3].alpha.where(left, 255), mask=left)
    assert slack(hand)[0] == EXACT
