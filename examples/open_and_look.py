"""Open the first joint of a bundle in steps and look at it.

    python examples/open_and_look.py demo/bundle pictures

Writes colours.png, labels.png and depth.png: five steps from the first state to the last, side by side.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from splatart_ns.bundle import load, orbit_camera
from splatart_ns.errors import InputError
from splatart_ns.splats.palette import part_colours

STEPS, SIZE = 5, 256

if len(sys.argv) != 3:
    sys.exit("usage: python examples/open_and_look.py BUNDLE PICTURES, the folder of a bundle and one for pictures")
bundle, folder = map(Path, sys.argv[1:])
try:
    obj = load(bundle)
except InputError as error:
    sys.exit(str(error))
folder.mkdir(parents=True, exist_ok=True)
if not obj.joints:
    sys.exit(f"{bundle} has no joint that moves.")
name, joint = next(iter(obj.joints.items()))
first, last = joint.values.reshape(len(joint.values), -1)[[0, -1]]  # at the first and the last state
values = torch.lerp(first, last, torch.linspace(0, 1, STEPS, dtype=torch.float64)[:, None])
q = {name: values if len(first) > 1 else values[:, 0]}

camera = orbit_camera(obj.centre, obj.radius, azimuth=0.8, elevation=0.5, width=SIZE, height=SIZE)
picture = obj.render(camera, q)  # a batch of STEPS pictures
colours = picture.over(torch.ones(3))
labels = part_colours(int(picture.ids.max()))[picture.part_ids.cpu()]
near, far = picture.depth[picture.alpha > 0.5].aminmax()
depth = ((far - picture.depth) / (far - near)).clamp(0, 1) * picture.alpha

for kind, images in {"colours": colours, "labels": labels, "depth": depth}.items():
    row = np.concatenate(list((255 * images).byte().cpu().numpy()), axis=1)
    Image.fromarray(row).save(folder / f"{kind}.png")

child = obj.link_poses(q)[joint.child]
print(f"{name} moves {joint.child} from\n{child[0].numpy().round(3)} to\n{child[-1].numpy().round(3)}")
