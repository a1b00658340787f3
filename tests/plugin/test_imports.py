"""Processes that only fit: what they leave out is there for who asks."""

import subprocess
import sys

SCRIPT = """
import sys
from splatart_ns.plugin.imports import few_imports

with few_imports():
    import torch
    import splatart_ns.plugin.fit
    from splatart_ns.geometry.se3 import from_rotation_translation

weight = torch.nn.Parameter(torch.ones(3))
optimizer = torch.optim.Adam([weight])
for _ in range(2):
    optimizer.zero_grad()
    weight.square().sum().backward()
    optimizer.step()
assert from_rotation_translation(torch.eye(3), torch.ones(2, 3)).shape == (2, 4, 4)
print(*{"sympy", "torch._inductor", "torchvision.models.resnet"} & set(sys.modules))

# In the midst of what this imports all modules are asked for their files.
torch.testing.assert_close(torch.ones(2), torch.ones(2))
assert torch.equal(torch.compile(lambda x: 2 * x, backend="eager")(torch.ones(2)), torch.full((2,), 2.0))
import torchvision
print(torchvision.models.resnet18.__name__, torch._dynamo.__name__, "sympy" in sys.modules)
"""


def test_modules_that_no_fit_uses_are_loaded_when_they_are_used():
    told = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout
    assert told == "\nresnet18 torch._dynamo True\n"
