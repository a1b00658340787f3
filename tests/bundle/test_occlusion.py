"""What lies around a part, and which parts do not count."""

import torch
import trimesh
from solid_splat import splat_on

from splatart_ns.bundle import Bundle, Part
from splatart_ns.bundle.occlusion import Extent, surroundings


def shift(x, z=0.0):
    T = torch.eye(4, dtype=torch.float64)
    T[0, 3], T[2, 3] = x, z
    return T


def part(number, name, size, at, *shifts):
    """A box at its place in the first state, shifted by so much in the others."""
    box = trimesh.creation.box(size)
    box.apply_translation(at)
    motion = torch.stack([torch.eye(4, dtype=torch.float64), *shifts])
    return Part(number, name, splat_on(box, 400, 0.9), motion, torch.zeros(len(motion), 6, 6, dtype=torch.float64))


def bundle(*parts):
    states = [f"state_{k:02d}" for k in range(len(parts[0].motion))]
    return Bundle(parts=list(parts), joints=[], root=parts[0].name, states=states, length_unit="metre")


def test_what_lies_beside_a_part_is_told_as_seen_from_it_at_every_state():
    base = part(1, "base", (1, 1, 0.2), (0, 0, 0), shift(0))
    cart = part(2, "cart", (0.4, 0.4, 0.2), (0, 0, 0.2), shift(0.3))
    around_base, around_cart = (surroundings(bundle(base, cart), p) for p in (base, cart))
    assert [round(float(s.means[:, 0].mean()), 1) for s in around_base] == [0.0, 0.3]
    assert [round(float(s.means[:, 0].mean()), 1) for s in around_cart] == [0.0, -0.3]


def test_a_drawer_and_its_body_do_not_hide_each_other_by_being_in_each_other():
    body = part(1, "body", (1, 1, 1), (0, 0, 0), shift(0))
    drawer = part(2, "drawer", (0.8, 0.8, 0.3), (0, 0, 0), shift(0.7))
    lamp = part(3, "lamp", (0.2, 0.2, 0.2), (0, 0, 0.7), shift(0))
    parts = bundle(body, drawer, lamp)
    assert [len(s) for s in surroundings(parts, body)] == [len(lamp.splat)] * 2
    assert [len(s) for s in surroundings(parts, drawer)] == [len(lamp.splat)] * 2
    assert [len(s) for s in surroundings(parts, lamp)] == [len(body.splat) + len(drawer.splat)] * 2
    assert surroundings(bundle(body, drawer), body) == []


def test_of_many_states_a_few_are_looked_at():
    base = part(1, "base", (1, 1, 0.2), (0, 0, 0), *[shift(0)] * 9)
    cart = part(2, "cart", (0.4, 0.4, 0.2), (0, 0, 0.2), *[shift(0.01 * k) for k in range(9)])
    assert 2 <= len(surroundings(bundle(base, cart), base)) <= 4


def test_a_part_without_opaque_gaussians_has_nothing_around_it_and_hides_nothing():
    base, cart = part(1, "base", (1, 1, 0.2), (0, 0, 0)), part(2, "cart", (0.4, 0.4, 0.2), (0, 0, 0.2))
    cart.splat.opacity_logits[:] = -5.0
    assert surroundings(bundle(base, cart), base) == surroundings(bundle(base, cart), cart) == []


def test_an_extent_holds_a_part_whichever_way_it_lies():
    g = torch.Generator().manual_seed(0)
    box = (torch.rand(4000, 3, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([2.0, 0.5, 0.1]).double()
    R = torch.linalg.qr(torch.randn(3, 3, generator=g, dtype=torch.float64)).Q
    extent = Extent.of(box @ R.mT)
    assert extent.holds(box @ R.mT).double().mean() > 0.9
    assert not extent.holds(1.2 * torch.eye(3).double()[:1] @ R.mT).any()
    assert not extent.holds(torch.tensor([[0.0, 0.0, 0.08]]).double() @ R.mT).any()
    middle = torch.zeros(1, 3)
    assert extent.holds(middle).all() and not extent.holds(middle, 0.06).any()
    assert abs(extent.diameter - 2.06) < 0.05


def test_an_extent_of_one_point_is_that_point():
    assert Extent.of(torch.ones(1, 3, dtype=torch.float64)).holds(torch.ones(1, 3)).all()
