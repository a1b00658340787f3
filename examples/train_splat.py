"""Train a splat on a built-in object with a plain torch loop: no CUDA, no nerfstudio, nothing to download.

    OMP_WAIT_POLICY=PASSIVE python examples/train_splat.py

The loop is written as for gsplat: only the import of `rasterization` differs.
"""

import tempfile
import time
from pathlib import Path

import torch

from splatart_ns.capture.formats import load_capture
from splatart_ns.capture.procedural import synthesize_object
from splatart_ns.capture.synthesis_options import SynthesisOptions
from splatart_ns.capture.view import load_views
from splatart_ns.rasterize import rasterization
from splatart_ns.rasterize.ssim import l1_ssim_loss

COUNT, STEPS, DEGREE = 10_000, 1_500, 1

torch.manual_seed(0)
with tempfile.TemporaryDirectory() as folder:
    options = SynthesisOptions(train_views=60, test_views=8, resolution=256)
    capture = load_capture(synthesize_object("hinge", Path(folder) / "hinge", options))
    train, test = (load_views(capture, 0, split) for split in ("train", "test"))

# Start in the visual hull: random points that every silhouette contains.
points = 2 * torch.rand(2_000_000, 3) - 1
for view in train:
    x, y, z = view.K @ (view.viewmat[:3, :3] @ points.T + view.viewmat[:3, 3:])
    column, row = (x / z).long().clamp(0, view.width - 1), (y / z).long().clamp(0, view.height - 1)
    points = points[view.alpha[row, column] > 0]
spacing = (8 / 2_000_000 * len(points) / COUNT) ** (1 / 3)

rates = {"means": 1e-3, "quats": 2e-2, "log_scales": 3e-2, "opacity_logits": 3e-2, "dc": 1e-2, "rest": 1e-3}
splat = {
    "means": points[torch.randint(len(points), (COUNT,))],
    "quats": torch.randn(COUNT, 4),
    "log_scales": torch.full((COUNT, 3), spacing / 4).log(),
    "opacity_logits": torch.full((COUNT,), 0.5).logit(),
    "dc": torch.zeros(COUNT, 1, 3),
    "rest": torch.zeros(COUNT, (DEGREE + 1) ** 2 - 1, 3),
}
splat = {name: tensor.requires_grad_() for name, tensor in splat.items()}
optimizer = torch.optim.Adam([{"params": splat[k], "lr": rates[k]} for k in splat], eps=1e-15, fused=True)
schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.03 ** (1 / STEPS))
white = torch.ones(1, 3)


def render(view):
    s, sh = splat, torch.cat([splat["dc"], splat["rest"]], 1)
    gaussians = s["means"], s["quats"], s["log_scales"].exp(), s["opacity_logits"].sigmoid(), sh
    camera = view.viewmat[None], view.K[None], view.width, view.height
    return rasterization(*gaussians, *camera, sh_degree=DEGREE, backgrounds=white)[0][0]


start = time.perf_counter()
for step in range(STEPS):
    view = train[torch.randint(len(train), ()).item()]
    loss = l1_ssim_loss(render(view), view.rgb_on(white[0]))
    loss.backward()
    optimizer.step()
    optimizer.zero_grad()
    schedule.step()
    if (step + 1) % 500 == 0:
        with torch.no_grad():
            errors = [(render(view) - view.rgb_on(white[0])).square().mean() for view in test]
        psnr = torch.stack([-10 * e.log10() for e in errors]).mean()
        print(f"step {step + 1}: test PSNR {psnr:.2f} dB after {time.perf_counter() - start:.0f} s", flush=True)
