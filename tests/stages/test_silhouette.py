from dataclasses import replace

import torch
import torch.nn.functional as F
from part_scene import box, photograph

from splatart_ns.capture.capture import UNLABELLED
from splatart_ns.splats.splat import Splat
from splatart_ns.stages.silhouette import _shares, rendered_silhouette, with_rendered_labels, with_silhouette

OBJECT = box(1, (0.5, 0.4, 0.3), (0.0, 0.0, 0.0))
FLOOR = box(0, (2.0, 2.0, 0.1), (0.0, 0.0, -0.5))
VIEW = photograph(OBJECT, count=6)[1]


def test_an_opaque_image_gets_the_silhouette_of_its_labels():
    labels = VIEW.labels.clone()
    labels[0, :5] = UNLABELLED
    made = with_silhouette(replace(VIEW, alpha=None, labels=labels))
    assert torch.equal(made.alpha > 0, VIEW.labels > 0) and int(made.alpha.max()) == 255
    assert not made.mask[0, :5].any() and made.mask.sum() == made.mask.numel() - 5
    assert with_silhouette(VIEW) is VIEW
    assert with_silhouette(replace(VIEW, alpha=None, labels=None)) is None


def test_surroundings_are_no_part_of_a_rendered_silhouette():
    opaque = replace(VIEW, alpha=None, labels=None)
    silhouette = rendered_silhouette(opaque, Splat.cat([OBJECT, FLOOR])).alpha > 127
    differ = silhouette != (VIEW.labels > 0)
    assert differ.float().mean() < 0.03 < silhouette.float().mean()
    assert rendered_silhouette(opaque, FLOOR).alpha.max() < 10


def test_a_view_without_labels_gets_those_that_the_splat_shows():
    parts = Splat.cat([OBJECT, box(2, (0.3, 0.3, 0.2), (0.1, 0.0, 0.3))])
    view = photograph(parts, count=6)[1]
    made = with_rendered_labels(replace(view, labels=None), parts)
    inside = (view.alpha > 0) & (view.labels > 0)
    assert (made.labels == view.labels)[inside].float().mean() > 0.99
    assert set(view.labels[inside].tolist()) == {1, 2}
    assert (made.labels[view.alpha == 0] == 0).all()
    assert with_rendered_labels(view, parts) is view


def test_what_the_splat_misses_stays_unlabelled():
    made = with_rendered_labels(replace(VIEW, labels=None), OBJECT.select(OBJECT.means[:, 0] < 0))
    missed = (made.labels == UNLABELLED) & (VIEW.alpha > 0)
    assert 0.1 < missed.sum() / (VIEW.alpha > 0).sum() < 0.9
    assert not (made.labels == UNLABELLED)[VIEW.alpha == 0].any()


def test_a_silhouette_is_whole_where_the_object_lets_a_little_of_what_is_behind_it_through():
    opaque = replace(VIEW, alpha=None, labels=None)
    thin = replace(OBJECT, opacity_logits=torch.full_like(OBJECT.opacity_logits, -1.6))
    splat = Splat.cat([thin, FLOOR, box(0, (3.0, 3.0, 0.1), (0.0, 0.0, -1.2))])
    inner = F.max_pool2d((VIEW.labels == 0).float()[None], 5, 1, 2)[0] == 0
    share = 1 - _shares(opaque, splat)[..., 0][inner]
    assert 0.7 < share.median() < 0.95
    silhouette = rendered_silhouette(opaque, splat).alpha
    assert (silhouette[inner] == 255).float().mean() > 0.95
    assert silhouette[VIEW.labels == 0].float().mean() < 10
