import math

import mpmath
import pytest
import torch
from scenes import HEIGHT, WIDTH, world_scene

from splatart_ns.rasterize.rasterization import rasterization
from splatart_ns.rasterize.strategies import compute_relocation, enable_gsplat_strategies, quat_scale_to_covar_preci

BINOMS = torch.tensor([[float(math.comb(n, k)) for k in range(51)] for n in range(51)])


@pytest.mark.parametrize("n", [1, 2, 5, 51])
def test_relocation_follows_the_papers_double_sum(n):
    opacities, scales = torch.tensor([0.01, 0.3, 0.9, 0.999]), torch.rand(4, 3) + 0.1
    new_opacities, new_scales = compute_relocation(opacities, scales, torch.full((4,), n), BINOMS)
    torch.testing.assert_close(1 - (1 - new_opacities) ** n, opacities, rtol=1e-5, atol=1e-5)
    for i, old in enumerate(opacities.tolist()):
        new = 1 - (1 - old) ** (1 / n)
        total = sum(
            math.comb(j - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for j in range(1, n + 1)
            for k in range(j)
        )
        torch.testing.assert_close(new_scales[i], scales[i] * old / total)


@pytest.mark.parametrize("old", [1e-6, 0.5, 0.999999, 1.0])
def test_many_gaussians_in_the_place_of_an_opaque_one_keep_their_digits(old):
    """The alternating sum of 51 terms of up to 1e14 has to be summed in many digits, or not at all."""
    opacity = torch.tensor([old], dtype=torch.float64)
    new_opacity, new_scale = compute_relocation(opacity, torch.ones(1, 1).double(), torch.tensor([51]), BINOMS)
    with mpmath.workdps(50):
        new = 1 - (1 - mpmath.mpf(float(opacity))) ** (mpmath.mpf(1) / 51)
        total = mpmath.fsum(-((-new) ** k) * mpmath.binomial(51, k) / mpmath.sqrt(k) for k in range(1, 52))
        expected = float(new), old / float(total)
    assert new_opacity.item() == pytest.approx(expected[0], rel=1e-14)
    assert new_scale.item() == pytest.approx(expected[1], rel=1e-14)


def test_more_than_the_most_ratio_counts_as_that():
    one = torch.tensor([0.5]), torch.ones(1, 3)
    for a, b in zip(
        compute_relocation(*one, torch.tensor([90]), BINOMS),
        compute_relocation(*one, torch.tensor([51]), BINOMS),
        strict=True,
    ):
        assert torch.equal(a, b)


@pytest.mark.parametrize("triu", [False, True])
def test_covariances_equal_gsplats(triu):
    gsplat_impl = pytest.importorskip("gsplat.cuda._torch_impl")
    s = world_scene()
    ours = quat_scale_to_covar_preci(s["quats"], s["scales"], triu=triu)
    theirs = gsplat_impl._quat_scale_to_covar_preci(s["quats"], s["scales"], triu=triu)
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a, b)
    assert quat_scale_to_covar_preci(s["quats"], s["scales"], False, False) == (None, None)


def test_gsplats_mcmc_strategy_relocates_adds_and_moves(monkeypatch):
    gsplat = pytest.importorskip("gsplat")
    from gsplat.strategy import ops

    for name in ("compute_relocation", "quat_scale_to_covar_preci"):
        monkeypatch.setattr(ops, name, None)  # and back, afterwards
    enable_gsplat_strategies()
    torch.manual_seed(0)
    s = {k: v.float() if torch.is_tensor(v) else v for k, v in world_scene().items()}
    s["opacities"][:20] = 0.001
    params = torch.nn.ParameterDict(
        dict(means=s["means"], quats=s["quats"], scales=s["scales"].log(), opacities=s["opacities"].logit())
    )
    optimizers = {name: torch.optim.Adam([param], lr=0.01) for name, param in params.items()}
    strategy = gsplat.MCMCStrategy(cap_max=70, refine_start_iter=0, refine_every=1)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    for step in range(1, 4):
        before = params["means"].detach().clone()
        image, _, info = rasterization(
            *(params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()),
            *(torch.ones(len(before), 3), s["viewmats"], s["Ks"], WIDTH, HEIGHT),
        )
        image.square().sum().backward()
        strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-3)
        assert len(params["means"]) == min(70, int(1.05 * len(before)))
        assert (params["opacities"].sigmoid() > 0.004).all()
        assert all(p.isfinite().all() for p in params.values())
