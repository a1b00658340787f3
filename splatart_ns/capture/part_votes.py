"""What the labelled views say of each point of the object's surface, and which of them say something else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from splatart_ns.capture.hull import DepthBuffer, footprint, project, widened
from splatart_ns.capture.view import View

_CLEAR = 0.66
"""A point belongs to a part when this share of its votes, and two at least, say so."""


@dataclass(frozen=True)
class Ballot:
    """What one view says of the points that it sees."""

    points: Tensor
    """Their indices [M]."""
    label: Tensor
    """The label of the pixel each falls into [M]."""
    near: Tensor
    """Whether a label is there or within half a voxel's diagonal, bool [P + 1, M]."""
    depths: DepthBuffer
    """How all points of the surface lie before each other."""

    def verdict(self, own: Tensor, parts: Tensor) -> tuple[Tensor, Tensor]:
        """Which of the points that it sees, which are of parts `own` [M], the view says are so, and which it says are
        not: bool [M] each. `parts` [N] are those of the whole surface.

        A pixel nearby of the right label is enough. Where points of the part that it says are hardly further away, it
        says nothing: parts may be thinner than a voxel, and the hull fills hollows between them.
        """
        right = self.near[own, torch.arange(len(own))]
        unsure = torch.zeros_like(right)
        for label in range(1, len(self.near)):
            unsure |= self.near[label] & self.depths.as_near(parts == label)[self.points]
        return right, ~right & ~unsure


@dataclass(frozen=True)
class PartVotes:
    """The votes of labelled views on points of a surface."""

    counts: Tensor
    """[N, P + 1]; label 0 is background."""
    ballots: tuple[Ballot, ...]
    """One a view."""

    def parts(self) -> Tensor:
        """The part of each point [N], 0 where it is not clear."""
        return _majority(self.counts)

    def without(self, ballot: Ballot) -> PartVotes:
        """The votes of the other views."""
        counts = self.counts.clone()
        counts[ballot.points, ballot.label] -= 1
        return PartVotes(counts, tuple(other for other in self.ballots if other is not ballot))

    def disagreement(self, ballot: Ballot) -> tuple[Tensor, Tensor]:
        """Of the points of each part by the other views' votes of which a view says anything, the share that it says is
        another, and their number: both [P + 1]."""
        parts = self.without(ballot).parts()
        own = parts[ballot.points]
        verdict = ballot.verdict(own, parts)
        right, wrong = (torch.bincount(own[says], minlength=self.counts.shape[1]) for says in verdict)
        return wrong / (right + wrong).clamp_min(1), right + wrong


def read_ballots(views: Sequence[View], points: Tensor, size: float, num_parts: int) -> tuple[Ballot, ...]:
    """What labelled views say of voxels [N, 3] of a surface."""
    ballots = []
    for view in views:
        depths = DepthBuffer.of(view, points, size)
        index = torch.nonzero(depths.visible()).flatten()
        column, row, _, _ = project(view, points[index])
        label = view.labels[row, column].long()
        known = label <= num_parts
        index, label, column, row = index[known], label[known], column[known], row[known]
        reach = max(1, footprint(view, size))
        near = torch.zeros(num_parts + 1, len(index), dtype=torch.bool)
        for part in torch.unique(view.labels[view.labels <= num_parts]).tolist():
            near[part] = widened(view.labels == part, reach)[row, column]
        ballots.append(Ballot(index, label, near, depths))
    return tuple(ballots)


def vote(views: Sequence[View], points: Tensor, size: float, num_parts: int) -> PartVotes:
    """The votes of labelled views on voxels [N, 3] of a surface."""
    counts = torch.zeros(len(points), num_parts + 1)
    ballots = read_ballots(views, points, size, num_parts)
    for ballot in ballots:
        counts[ballot.points, ballot.label] += 1
    return PartVotes(counts, ballots)


def _majority(counts: Tensor) -> Tensor:
    most, label = counts.max(1)
    return torch.where((most >= 2) & (most >= _CLEAR * counts.sum(1)), label, 0)
