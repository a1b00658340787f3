"""The textbook definition, pixel by pixel through autograd: what every backend is compared with."""

import torch


def project(means, quats, scales, viewmats, Ks, margins):
    """Means, covariances before the blur, and depths by matrices; `margins` limit x/z and y/z in the slope."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
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
    """Front to back over black, one camera after another, one Gaussian after another, all pixels at once."""
    ys, xs = torch.meshgrid(*(torch.arange(n).to(means2d) + 0.5 for n in (height, width)), indexing="ij")
    images, alphas = [], []
    for c in range(len(means2d)):
        T = torch.ones(height, width, dtype=means2d.dtype)
        alive = torch.ones(height, width, dtype=torch.bool)
        image = torch.zeros(height, width, colors.shape[-1], dtype=means2d.dtype)
        for i in depths[c].argsort(stable=True).tolist():
            if not visible[c, i]:
                continue
            dx, dy = xs - means2d[c, i, 0], ys - means2d[c, i, 1]
            q = conics[c, i, 0] * dx * dx + 2 * conics[c, i, 1] * dx * dy + conics[c, i, 2] * dy * dy
            alpha = (opacities[c, i] * torch.exp(-0.5 * q)).clamp_max(0.999)
            alpha = torch.where(alpha >= 1 / 255, alpha, torch.zeros_like(alpha))
            alive = alive & (T * (1 - alpha) > 1e-4)
            alpha = torch.where(alive, alpha, torch.zeros_like(alpha))
            image = image + (T * alpha)[..., None] * colors[c, i]
            T = T * (1 - alpha)
        images.append(image)
        alphas.append(1 - T)
    return torch.stack(images), torch.stack(alphas)[..., None]
