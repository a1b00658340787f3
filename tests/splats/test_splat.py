import pytest
import torch
import torch.nn.functional as F

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
