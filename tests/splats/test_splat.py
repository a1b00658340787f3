import pytest
import torch
import torch.nn.functional as F

from splatart_ns.geometry.spherical_harmonics import sh_basis
from splatart_ns.splats import Splat


def splat_of_degree(degree: int) -> Splat:
    """Five Gaussians of the same geometry, whatever the degree."""
    generator = torch.Generator().manual_seed(0)
    means, scales, quats = (torch.randn(5, n, generator=generator) for n in (3, 3, 4))
    sh = torch.randn(5, (degree + 1) ** 2, 3, generator=generator)
    return Splat(means, quats, scales, torch.zeros(5), sh)


@pytest.mark.parametrize("degrees", [(0, 3), (3, 0), (1, 1), (2, 0, 1)])
def test_splats_of_any_degrees_are_put_together_and_keep_their_colours(degrees: tuple[int, ...]) -> None:
    splats = [splat_of_degree(degree) for degree in degrees]
    whole = Splat.cat(splats)
    assert (len(whole), whole.sh_degree) == (5 * len(splats), max(degrees))
    for splat, sh in zip(splats, whole.sh.split(5), strict=True):
        assert torch.equal(sh, F.pad(splat.sh, (0, 0, 0, sh.shape[1] - splat.sh.shape[1])))


def test_base_colours_are_those_that_opposite_views_agree_on() -> None:
    splat = splat_of_degree(1)
    direction = F.normalize(torch.tensor([[0.3, -0.5, 0.8]]), dim=-1).expand(5, 3)
    there, back = (torch.einsum("nk,nkc->nc", sh_basis(d, 1), splat.sh) + 0.5 for d in (direction, -direction))
    assert torch.allclose(splat.base_colours, ((there + back) / 2).clamp(0, 1), atol=1e-6)
