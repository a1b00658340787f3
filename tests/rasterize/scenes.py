"""Random Gaussians for the rasterizer's tests, and how their images and gradients are taken."""

import torch

WIDTH, HEIGHT = 45, 35
LEAVES = ("means2d", "conics", "opacities", "colors")
WORLD_LEAVES = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def pixel_scene(C=1, N=120, D=3, width=29, height=21, seed=0):
    """Random 2D Gaussians, float64, some of them outside the image."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means2d = rand(C, N, 2) * torch.tensor([width + 8.0, height + 8.0]) - 4
    L = (rand(C, N, 2, 2) - 0.5) * 12
    inverse = (L @ L.mT + 0.3 * torch.eye(2)).inverse()
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    return dict(
        means2d=means2d,
        conics=conics,
        opacities=rand(C, N),
        colors=rand(C, N, D) - 0.3,
        depths=rand(C, N) + 1,
        visible=rand(C, N) > 0.1,
        width=width,
        height=height,
    )


def world_scene(N=60, C=1, D=3, seed=0, width=WIDTH, height=HEIGHT):
    """A blob in front of C cameras, float64 values that float32 holds exactly."""
    generator = torch.Generator().manual_seed(seed)

    def randn(*shape):
        return torch.randn(*shape, generator=generator)

    viewmats = torch.eye(4).repeat(C, 1, 1)
    viewmats[:, :3, 3] = torch.tensor([0.1, -0.2, 4.0]) + 0.3 * torch.arange(C)[:, None]
    values = dict(
        means=randn(N, 3) * 0.7,
        quats=randn(N, 4),
        scales=(0.6 * randn(N, 3) - 2).exp(),
        opacities=randn(N).sigmoid(),
        colors=randn(N, D).sigmoid(),
        viewmats=viewmats,
        Ks=torch.tensor([[50.0, 0, 22], [0, 48, 18], [0, 0, 1]]).repeat(C, 1, 1),
    )
    return {k: v.double() for k, v in values.items()} | dict(width=width, height=height)


def image_and_gradients(function, scene, dtype, leaves=LEAVES):
    """Image with alpha, and the gradients by `leaves` of a random functional of it."""
    scene = {k: v.to(dtype) if torch.is_tensor(v) and v.is_floating_point() else v for k, v in scene.items()}
    for name in leaves:
        scene[name] = scene[name].clone().requires_grad_()
    image = torch.cat(function(**scene)[:2], -1)
    weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)
    return image, torch.autograd.grad(image, [scene[name] for name in leaves], weights)
