"""The textbook definition, pixel by pixel through autograd: what every backend is compared with."""

import torch


def project(means, quats, scales, viewmats, Ks, margins):
    """Means, covariances before the blur, and depths by matrices; `margins` limit x/z and y/z in the slope."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    w, x, y, z = torch.nn.functional.normalize(quats / largest.where(largest > 0, 1.0), dim=-1).unbind(-1)
    R = torch.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).view(-1, 3, 3)
    R = torch.where((quats == 0).all(-1)[:, None, None], torch.eye(3).to(R), R)
    M = R * scales[:, None]
    world = M @ M.mT
    W, t = viewmats[:, None, :3, :3], viewmats[:, None, :3, 3]
    local = (W @ means[..., None])[..., 0] + t
    depths = local[..., 2]
    safe = depths.where(depths > 0.01, torch.ones_like(depths))
    u, v = local[..., 0] / safe, local[..., 1] / safe
    fx, fy, cx, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    means2d = torch.stack([fx * u + cx, fy * v + cy], -1)
    u, v = (a.clamp(low, high) for a, (low, high) in zip((u, v), margins, strict=True))
    zero = torch.zeros_like(u)
    J = torch.stack([fx / safe, zero, -fx * u / safe, zero, fy / safe, -fy * v / safe], -1).unflatten(-1, (2, 3))
    JW = J @ W
    cov = JW @ world @ JW.mT
    return means2d, cov, depths


def composite(means2d, conics, opacities, colors, depths, visible, width, height):
    """Front to back over black, one camera after another, all Gaussians at every pixel."""
    images, alphas = [], []
    for c in range(len(means2d)):
        order, peaks, alpha, behind = _layers(c, means2d, conics, opacities, depths, visible, width, height)
        front = torch.cat([torch.ones_like(behind[:1]), behind[:-1]])
        weights = torch.where(behind > 1e-4, alpha * front, torch.zeros_like(alpha))
        images.append(torch.einsum("nhw,nd->hwd", weights, colors[c, order]))
        alphas.append(weights.sum(0))
    return torch.stack(images), torch.stack(alphas)[..., None]


def margin(means2d, conics, opacities, colors, depths, visible, width, height):
    """How near alphas come to the cut at 1/255 and transmittances to that at 1e-4: rounding may jump across them."""
    least = 1.0
    for c in range(len(means2d)):
        _, peaks, _, behind = _layers(c, means2d, conics, opacities, depths, visible, width, height)
        for value in ((255 * peaks).log(), (1e4 * behind).log()):
            least = min([least, *value.abs().flatten().tolist()])
    return least


def _layers(c, means2d, conics, opacities, depths, visible, width, height):
    """Gaussians of camera c from front to back, their alphas [n, H, W] before and after cuts, what they let through."""
    ys, xs = torch.meshgrid(*(torch.arange(n).to(means2d) + 0.5 for n in (height, width)), indexing="ij")
    order = depths[c].argsort(stable=True)
    order = order[visible[c, order]]
    x, y = means2d[c, order, :, None, None].unbind(1)
    a, b, d = conics[c, order, :, None, None].unbind(1)
    dx, dy = xs - x, ys - y
    q = a * dx * dx + 2 * b * dx * dy + d * dy * dy
    peaks = opacities[c, order, None, None] * torch.exp(-0.5 * q)
    alpha = peaks.clamp_max(0.999)
    alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
    return order, peaks, alpha, (1 - alpha).log().cumsum(0).exp()


def rasterization(**scene):
    """All of it."""
    return composite(**projected(**scene))


def projected(means, quats, scales, opacities, colors, viewmats, Ks, width, height):
    """Arguments of `composite`, with gsplat's culling: by depth, and where a circle of 3 sigma misses the image."""
    fx, fy, cx, cy = (Ks[:, i, j, None] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    margins = [
        ((-cx - 0.15 * width) / fx, (1.15 * width - cx) / fx),
        ((-cy - 0.15 * height) / fy, (1.15 * height - cy) / fy),
    ]
    means2d, cov, depths = project(means, quats, scales, viewmats, Ks, margins)
    cov = cov + 0.3 * torch.eye(2).to(cov)
    inverse = torch.linalg.inv(cov)
    conics = torch.stack([inverse[..., 0, 0], inverse[..., 0, 1], inverse[..., 1, 1]], -1)
    with torch.no_grad():
        radii = (3 * torch.linalg.eigvalsh(cov)[..., 1].sqrt()).ceil()
        inside = (means2d + radii[..., None] > 0) & (means2d - radii[..., None] < torch.tensor([width, height]))
    C, N = depths.shape
    return dict(
        means2d=means2d,
        conics=conics,
        opacities=opacities.expand(C, N),
        colors=colors.expand(C, N, -1),
        depths=depths,
        visible=(depths > 0.01) & inside.all(-1),
        width=width,
        height=height,
    )
