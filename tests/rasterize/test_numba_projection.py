import pytest
import torch
from test_projection import HEIGHT, WIDTH, cameras, gaussians, outputs_and_gradients

pytest.importorskip("numba")
from splatart_ns.rasterize import numba_projection, numba_spherical_harmonics, projection
from splatart_ns.rasterize.rasterization import sh_colors


def scene(N=700):
    """Some of these Gaussians lie behind the cameras or outside the image."""
    means, quats, scales = gaussians(N)
    means[:, 0] += torch.linspace(-6, 6, N)
    means[::7, 2] -= 9
    return tuple(x.float() for x in (means, quats, scales, *cameras()))


def visible_outputs(project, visible):
    """The outputs of what is visible, the rest zeros: culled rows hold anything."""

    def outputs(*inputs):
        p = project(*inputs, WIDTH, HEIGHT)
        masks = visible[..., None], visible, visible[..., None], visible
        values = p.means2d, p.depths, p.conics, p.compensations
        return tuple(value * mask for value, mask in zip(values, masks, strict=True))

    return outputs


def test_projection_equals_torchs_in_float64():
    inputs = scene()
    expected_radii = projection.project(*(x.double() for x in inputs), WIDTH, HEIGHT).radii
    radii = numba_projection.project(*inputs, WIDTH, HEIGHT).radii
    assert torch.equal(radii, expected_radii) and 0 < (radii == 0).sum() < radii.numel()
    outputs, gradients = outputs_and_gradients(
        visible_outputs(numba_projection.project, radii > 0), inputs, torch.float32
    )
    expected, expected_gradients = outputs_and_gradients(visible_outputs(projection.project, radii > 0), inputs)
    for a, b in zip(outputs + gradients, expected + expected_gradients, strict=True):
        assert a.dtype == torch.float32
        assert (a - b).norm() <= 2e-7 * b.norm()


def test_projection_does_not_depend_on_the_number_of_threads():
    before = torch.get_num_threads()
    results = []
    for threads in (1, 3):
        torch.set_num_threads(threads)
        inputs = scene()
        outputs = visible_outputs(numba_projection.project, torch.ones(2, len(inputs[0])))
        results.append(outputs_and_gradients(outputs, inputs, torch.float32))
    torch.set_num_threads(before)
    for a, b in zip(results[0][0] + results[0][1], results[1][0] + results[1][1], strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("shape", [(700, 16, 3), (2, 700, 16, 3)], ids=["shared", "per-camera"])
def test_spherical_harmonics_equal_torchs_in_float64(degree, shape):
    means, _, _, viewmats, _ = scene()
    sh = torch.randn(shape, generator=torch.Generator().manual_seed(2))
    results = []
    for function, dtype in ((sh_colors, torch.float64), (numba_spherical_harmonics.sh_colors, torch.float32)):
        leaves = [x.to(dtype).clone().requires_grad_() for x in (means, sh, viewmats)]
        colors = function(*leaves, degree)
        weights = torch.randn(colors.shape, generator=torch.Generator().manual_seed(3)).to(dtype)
        gradients = torch.autograd.grad(colors, leaves, weights, allow_unused=True)
        results.append([colors, *(torch.zeros(()) if g is None else g for g in gradients)])
    for a, b in zip(*results, strict=True):
        assert (a - b).norm() <= 5e-7 * a.norm()


def test_spherical_harmonics_at_the_cameras_centre_are_finite():
    means, sh = torch.zeros(1, 3, requires_grad=True), torch.ones(1, 16, 3, requires_grad=True)
    numba_spherical_harmonics.sh_colors(means, sh, torch.eye(4)[None], 3).sum().backward()
    assert means.grad.isfinite().all() and sh.grad.isfinite().all()
