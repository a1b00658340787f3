import itertools
import math

import pytest
import torch

from splatart_ns.stages.arborescence import cheapest_parents


@pytest.mark.parametrize("seed", range(20))
def test_the_parents_cost_least_of_all_trees(seed):
    generator = torch.Generator().manual_seed(seed)
    costs = {
        (a, b): float(torch.rand(1, generator=generator))
        for a in range(5)
        for b in range(5)
        if a != b and torch.rand(1, generator=generator) < 0.7
    }

    def total(parents):
        for part in range(1, 5):
            for _ in range(5):
                part = parents[part] if part else 0
            if part:
                return math.inf
        return math.fsum(costs.get((a, b), math.inf) for b, a in parents.items())

    every = [dict(zip(range(1, 5), choice, strict=True)) for choice in itertools.product(range(5), repeat=4)]
    best = min(map(total, every))
    parents = cheapest_parents(costs, 0)
    if math.isfinite(best):
        assert total(parents) == pytest.approx(best)
    else:
        assert len(parents) < 4
