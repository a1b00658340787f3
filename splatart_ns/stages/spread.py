"""Labels of what no labelled frame shows, from what lies beside it on the same surface, in its own state or another."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree
from torch import Tensor

from splatart_ns.geometry.se3 import matrix_from_quat
from splatart_ns.splats.splat import Splat

TOLD = 0.05
"""A Gaussian of which no labelled view shows this share lies behind others, and has the votes for what they are. Of a
cabinet with five labelled frames a third of these was labelled wrongly, a fiftieth of those that show twice as much."""
NEIGHBOURS = 12
"""Of Gaussians of one state; twice as many of those of several."""
ACROSS = 10.0
"""How many times further apart Gaussians count by what lies between them across the surfaces that they are flat on: a
drawer's side is near the wall that it slides along."""
SAME_COLOUR = 0.2
"""Gaussians of two states count by each other where no channel of their colours (0 to 1) differs by more: they are of
one place of a surface that rests."""
LEAST = 1e-3
"""Share of a label that is not told."""
HELD = 1e-6
"""Weight of the nearest label that is told: it decides where neighbours lead to none."""
ITERATIONS = 200
"""Of conjugate gradients, at most: of 200,000 Gaussians, a twentieth of them told, 1.5 % end with the wrong label where
without a limit 1.2 % do, in a fifth of the time."""


@torch.no_grad()
def spread(splat: Splat, logits: Tensor, told: Tensor, states: Tensor | None = None) -> Tensor:
    """Part logits [N, P + 1] in which the Gaussians that are not `told` [N] bool have what their neighbours say.

    Each label's share is the weighted mean of its neighbours', all at once (harmonic functions on a graph, Zhu,
    Ghahramani and Lafferty 2003). Those that are connected with nothing told have what the nearest told one has.

    Args:
        states: The state [N] that each is of, where they are of several in one world.
    """
    if told.all() or not told.any():
        return logits
    means, weights = splat.means.double().numpy(force=True), _weights(splat, states)
    known, unknown = (which.numpy(force=True).nonzero()[0] for which in (told, ~told))
    shares = logits.softmax(-1).double().numpy(force=True)[known]
    start = shares[cKDTree(means[known]).query(means[unknown])[1]]
    laplacian = (diags(np.asarray(weights.sum(1)).ravel()) - weights).tocsr()[unknown]
    inner = laplacian[:, unknown]
    missing = -laplacian[:, known] @ shares - inner @ start
    scale = diags(1 / inner.diagonal())
    inner = inner + HELD * diags(inner.diagonal())
    found = start + np.stack([cg(inner, of_label, maxiter=ITERATIONS, M=scale)[0] for of_label in missing.T], axis=1)
    logits = logits.clone()
    logits[~told] = torch.from_numpy(found.clip(LEAST, 1)).log().to(logits)
    return logits


def _weights(splat: Splat, states: Tensor | None) -> csr_matrix:
    """How much neighbouring Gaussians have to do with each other [N, N], symmetric: less the further they are apart and
    the more the surface that they are flat on turns between them. And nothing if they are of different `states` [N]
    and colours."""
    means = splat.means.double().numpy(force=True)
    R = matrix_from_quat(splat.quats).double()
    thin = splat.log_scales.argmin(-1)
    normals = R.mT[torch.arange(len(splat), device=thin.device), thin].numpy(force=True)
    k = min(NEIGHBOURS if states is None else 2 * NEIGHBOURS, len(means) - 1)
    j = cKDTree(means).query(means, k=k + 1)[1][:, 1:].ravel()
    i = np.arange(len(means)).repeat(k)
    apart = means[j] - means[i]
    across = sum(np.abs((apart * normals[ends]).sum(-1)) for ends in (i, j))
    distance2 = (apart**2).sum(-1) + (ACROSS * across) ** 2
    near = np.exp(-distance2 / (2 * np.median(distance2).clip(1e-30)))
    alike = np.abs((normals[i] * normals[j]).sum(-1)).clip(1e-3)
    weight = near * alike
    if states is not None:
        of, colours = states.numpy(force=True), splat.base_colours.numpy(force=True)
        weight[(of[i] != of[j]) & (np.abs(colours[i] - colours[j]).max(-1) > SAME_COLOUR)] = 0
    # Nothing is cut off from its neighbours, however far they are.
    weights = csr_matrix((weight + 1e-9, (i, j)), shape=(len(means), len(means)))
    return weights.maximum(weights.T)
