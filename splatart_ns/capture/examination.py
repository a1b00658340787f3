"""A capture looked at as a whole: do silhouettes, labels and states fit each other; which frame to label next."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from filecmp import cmp
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatart_ns.capture.capture import UNLABELLED, Capture, Frame, Normalization, Problem, State
from splatart_ns.capture.check import ONE_SPOT_MEND, check_capture
from splatart_ns.capture.hull import (
    POSES_MEND,
    carve,
    contradiction,
    fitting_views,
    project,
    silhouette,
    visible,
)
from splatart_ns.capture.images import orientation
from splatart_ns.capture.part_votes import Ballot, PartVotes, read_ballots, vote
from splatart_ns.capture.seen_surface import LEAST_CONFIRMED, measured_surface, object_pixels
from splatart_ns.capture.view import View, load_view
from splatart_ns.capture.worlds import OTHER_WORLDS_MEND
from splatart_ns.errors import InputError, printable
from splatart_ns.machine import num_cores

_PIXELS = 256
"""Frames are looked at with at most so many pixels along a side."""
_MOST_FRAMES = 300
"""Of each state; the labelled first, evenly spread."""
_FEW_FRAMES = 3
_WRONG_PART, _WRONG_OBJECT = 0.6, 0.3
"""A frame's labels are wrong where it contradicts the others on so much of a part, or of all parts together, which are
so many points:"""
_ENOUGH_POINTS = 30
_ENOUGH_BALLOTS = 10
"""With fewer labelled frames the votes are too few for the stricter limit of all parts together,"""
_ENOUGH_VIEWS = 16
"""and with fewer silhouettes the hull is too crude: right labels of an open hinge contradict each other on up to 32 %
with 12 frames, 21 % with 16, 15 % with 20."""
_MOST_WRONG = 30
"""So many wrong frames are named of each state."""
_WIDE_BAND, _SHIFTED_BAND = 0.02, 0.02
"""How far a labels' outline may lie from the silhouette's, as a share of the object's size: all frames, one frame."""
_ONE_UNIT = 1.2
"""Depths are of another unit than told if half of their ratios to the hull's lie within this factor."""
_STAYS, _MOVES = 0.93, 0.6
"""A part rests from one state to another if so much of it is at the same place, and moves if less than the second; in
between, another part may have moved before it."""
_OTHER_ID = 0.7
"""A part has another id in another state if so much more of its place is labelled as another part there, and of that
one's as it here, than of either's as itself. In 35 pairs of states of sound captures it was 0.2 at most, but 0.54 of a
book whose thin cover lies on its pages; 0.88 of a chest of other ids."""
_OTHER_SIZE, _WELL_SEEN, _LABELS_SHOW = 1.1, 100, 0.9
"""The intrinsics of two states differ if all parts, two at least, measure more or less by this factor in one of them.
Parts count that have so many points in both, and labelled frames must show so much of what all show. In 33 sound
captures the part that changed least did by a factor of 1.04 at most; with one state's fl_x and fl_y 1.2 times what they
are, or as much less, by 1.14 to 1.24."""


@dataclass(frozen=True)
class Coverage:
    """What the labelled training frames of a state show of a part."""

    state: str
    part: str
    frames: int
    """How many of them show it."""
    labelled: int
    """How many there are."""


@dataclass(frozen=True)
class Examination:
    """What `examine` found."""

    capture: Capture | None
    problems: tuple[Problem, ...]
    """Errors first."""
    coverage: tuple[Coverage, ...] = ()
    shown: tuple[float, ...] = ()
    """Of the surface that each state's training frames show, the share that labelled ones do; empty without hulls."""
    suggested: tuple[Frame, ...] = ()
    """The frames to label next, the most useful first."""

    @property
    def errors(self) -> int:
        return sum(problem.severity == "error" for problem in self.problems)


def as_text(examination: Examination) -> str:
    """Lines of problems, a table of what labelled frames show, the frames to label next, a sum."""
    lines = [f"{problem.severity}: {problem}" for problem in examination.problems]
    rows: dict[str, list[str]] = {}
    for item in examination.coverage:
        rows.setdefault(item.part, []).append(f"{item.frames} of {item.labelled}")
    states = [] if examination.capture is None else [printable(state.name) for state in examination.capture.states]
    if min(examination.shown, default=1) < 1:
        rows["of what all frames show"] = [f"{share:.0%}" for share in examination.shown]
    if rows:
        width = max(len("seen in labelled frames"), *map(len, rows))
        lines.append("  ".join(["seen in labelled frames".ljust(width), *(state.rjust(10) for state in states)]))
        for part, cells in rows.items():
            aligned = (c.rjust(max(10, len(state))) for c, state in zip(cells, states, strict=True))
            lines.append("  ".join([part.ljust(width), *aligned]))
    lines += [f"label next: {printable(str(frame.image))}" for frame in examination.suggested]
    counts = {"error": examination.errors, "warning": len(examination.problems) - examination.errors}
    lines.append(", ".join(f"{count} {kind}{'s' * (count != 1)}" for kind, count in counts.items()))
    return "\n".join(lines)


def as_json(examination: Examination) -> str:
    """The same as JSON, for scripts."""
    value = {
        "errors": examination.errors,
        "problems": [{**asdict(problem), "file": str(problem.file)} for problem in examination.problems],
        "coverage": [asdict(item) for item in examination.coverage],
        "shown": examination.shown,
        "label_next": [str(frame.image) for frame in examination.suggested],
    }
    return json.dumps(value, indent=1)


@dataclass
class _Evidence:
    """A state's frames, and the surface that its silhouettes leave."""

    state: State
    normalization: Normalization
    frames: list[Frame]
    views: list[View]
    labelled_for_training: list[View]
    """Also those that fit no others, which `views` lose."""
    points: Tensor = field(default_factory=lambda: torch.zeros(0, 3))
    """Voxels of the surface [N, 3] in the state's normalised world; none where there is no hull."""
    size: float = 0.0
    votes: PartVotes | None = None

    def part_sizes(self, parts: Sequence[int]) -> Tensor:
        """The spread of each part's points in the capture's unit, NaN where they are few: [P]."""
        own = self.votes.parts()
        points = [self.points[own == part].double() for part in parts]
        spreads = [x.std(0).norm() if len(x) >= _WELL_SEEN else torch.tensor(math.nan).double() for x in points]
        return torch.stack(spreads) / self.normalization.scale

    def shown_by_labels(self) -> float:
        """The share of the surface that training views show which labelled ones show, too."""
        shown, told = torch.zeros(2, len(self.points), dtype=torch.bool)
        for frame, view in zip(self.frames, self.views, strict=True):
            if frame.split == "train":
                seen = visible(view, self.points, self.size)
                shown |= seen
                if view.labels is not None:
                    told |= seen
        return float(told.sum() / shown.sum().clamp_min(1))

    @property
    def labelled(self) -> list[View]:
        return [view for view in self.views if view.labels is not None]

    def points_in(self, other: _Evidence) -> tuple[Tensor, float]:
        """The surface in another state's normalised world, and the voxels' size there."""
        world = self.points.double() / self.normalization.scale + torch.from_numpy(self.normalization.centre)
        there = (world - torch.from_numpy(other.normalization.centre)) * other.normalization.scale
        return there.float(), self.size * other.normalization.scale / self.normalization.scale


def examine(path: Path | str, suggest: int = 0) -> Examination:
    """All that `check_capture` finds, and what only frames together show.

    - Silhouettes: whether any point projects inside all of them, and which do not fit the others' visual hull.
    - Labels: frames that contradict the other frames on a part, by votes on the hull's surface; outlines of labels
      against silhouettes; parts that few labelled frames show.
    - States: whether one shows an earlier one's images; whether a part moved, one stayed, and one is labelled as
      another, between the first state and the others, if these share a world; whether parts are as large in the others
      as in the first.

    `suggest` frames to label next are chosen one after the other: the training frame that adds most to
    sum_v w_v (1 - 2^-n_v), where n_v labelled frames see the point v of the surface and w_v = 1 / (points of its part),
    so that parts and states count alike. (The greedy choice for a submodular sum reaches 1 - 1/e of the best one's;
    Nemhauser, Wolsey and Fisher 1978.)

    Never raises for what is in the capture.
    """
    capture, problems = check_capture(Path(path))
    if capture is None:
        return Examination(None, tuple(problems))
    evidence = [_read_evidence(state) for state in capture.states]
    num_parts = max(capture.parts, default=0)
    on_one_spot = [problem.file for problem in problems if problem.mend == ONE_SPOT_MEND]
    for one in evidence:
        if capture.path / one.state.name not in on_one_spot:  # from where frames tell nothing of each other
            problems.extend(_carve(capture, one))
            problems.extend(_check_depth(capture, one))
            problems.extend(_check_outlines(capture, one))
        if len(one.points) and one.labelled:
            one.votes = vote(one.labelled, one.points, one.size, num_parts)
            problems.extend(_check_votes(capture, one))
        problems.extend(_check_coverage(capture, one))
    if any(problem.mend in (POSES_MEND, ONE_SPOT_MEND) and problem.severity == "error" for problem in problems):
        # Wrong poses make cameras look anywhere.
        problems = [problem for problem in problems if problem.mend != OTHER_WORLDS_MEND]
    for k, other in enumerate(evidence[1:], start=1):
        if twin := next((state for state in capture.states[:k] if _same_images(state, other.state)), None):
            found, mend = f"it shows the same images as {twin.name}", "give it those of another configuration"
            problems.append(Problem("warning", capture.path / other.state.name, found, mend))
            continue
        elsewhere = list(_check_motion(capture, evidence[0], other)) if capture.worlds == "shared" else []
        problems.extend(elsewhere)
        if not elsewhere and capture.worlds != "similar":
            problems.extend(_check_sizes(capture, evidence[0], other))
    return Examination(
        capture=capture,
        problems=tuple(sorted(dict.fromkeys(problems), key=lambda p: p.severity != "error")),
        coverage=tuple(_coverage(one, i, name) for i, name in capture.parts.items() for one in evidence),
        shown=tuple(one.shown_by_labels() for one in evidence) if all(len(one.points) for one in evidence) else (),
        suggested=tuple(_suggest(evidence, num_parts, suggest)),
    )


def _read_evidence(state: State) -> _Evidence:
    frames = sorted(state.frames, key=lambda frame: frame.labels is None)
    if len(frames) > _MOST_FRAMES:
        labelled = sum(frame.labels is not None for frame in frames)
        head, rest = frames[:labelled], frames[labelled:]
        frames = _spread(head, _MOST_FRAMES) + _spread(rest, max(0, _MOST_FRAMES - labelled))
    normalization = Normalization.from_frames(frames)

    def read(frame: Frame) -> View | None:
        try:
            longest = max(frame.camera.width, frame.camera.height)
            return load_view(frame, normalization, -(-longest // _PIXELS))
        except InputError:  # `check_capture` has told
            return None

    with ThreadPoolExecutor(num_cores()) as pool:
        views = list(pool.map(read, frames))
    kept = [(frame, view) for frame, view in zip(frames, views, strict=True) if view is not None]
    labelled = [view for frame, view in kept if view.labels is not None and frame.split == "train"]
    return _Evidence(state, normalization, [frame for frame, _ in kept], [view for _, view in kept], labelled)


def _spread(frames: list[Frame], count: int) -> list[Frame]:
    """At most so many of the frames, evenly."""
    return frames if len(frames) <= count else [frames[i] for i in np.linspace(0, len(frames) - 1, count).astype(int)]


# ---------------------------------------------------------------------------------------------- silhouettes


def _carve(capture: Capture, one: _Evidence) -> Iterator[Problem]:
    """Problems with the silhouettes. Where they fit each other, the evidence gets its surface, and loses the frames
    that do not fit."""
    masks = [silhouette(view) for view in one.views]
    known = [i for i, mask in enumerate(masks) if mask is not None and mask.any() and not mask.all()]
    if len(known) < 3:
        return
    carving = carve([one.views[i] for i in known])
    place = capture.path / one.state.name
    if (found := contradiction(carving)) is not None:
        yield Problem("error", place, found, POSES_MEND + _as_stored(one.frames))
        return
    fitting = fitting_views(carving)
    if fitting is None or 2 * fitting.sum() < len(fitting):
        outside = float(carving.uncovered(torch.ones(len(known), dtype=torch.bool)).median())
        found = f"the silhouettes do not fit: {outside:.0%} of a frame's lies inside no point that all frames accept"
        severity = "error" if outside > 0.5 else "warning"
        yield Problem(severity, place, found, POSES_MEND + _as_stored(one.frames))
        return
    odd = [known[i] for i in torch.nonzero(~fitting).flatten().tolist()]
    for frame, view in ((one.frames[i], one.views[i]) for i in odd):
        what, cause, file = "silhouette", "mask", frame.object_mask or frame.image
        if view.alpha is None:
            what, cause, file = "outline of the labels", "labels", frame.labels
        found = f"the {what} of {frame.name} does not fit those of the other frames"
        mend = f"correct its pose or its {cause}{_as_stored([frame])}, or take the frame out"
        yield Problem("warning", file, found, mend)
    one.points, one.size = carving.surface(fitting), carving.size
    one.frames = [frame for i, frame in enumerate(one.frames) if i not in odd]
    one.views = [view for i, view in enumerate(one.views) if i not in odd]


def _as_stored(frames: Sequence[Frame]) -> str:
    """What masks must be, too, where EXIF data turn some of the frames' images; "" where they turn none.

    Tools draw masks on what viewers show. Where that is of the size of what is stored, only the silhouettes tell.
    """
    turned = [frame.name for frame in frames if orientation(frame.image) > 1]
    others = f" and {len(turned) - 1} more" if len(turned) > 1 else ""
    return f", drawn on the pixels as they are stored (EXIF data turn {turned[0]}{others})" if turned else ""


def _check_depth(capture: Capture, one: _Evidence) -> Iterator[Problem]:
    """Depth that contradicts itself from frame to frame, and what unit it seems to have."""
    measured = measured_surface(one.views)
    if measured.confirmed >= LEAST_CONFIRMED:
        for frame, view, trusted in zip(one.frames, one.views, measured.trusted_views(), strict=True):
            if view.depth is not None and ((view.depth > 0) & object_pixels(view)).any() and not trusted.depth.any():
                mend = "correct it, its depth_file_path or the frame's pose; it is not used"
                yield Problem("warning", frame.depth, f"the depth of {frame.name} contradicts the other frames'", mend)
        return
    ratios = [_depth_ratio(view, one.points, one.size) for view in one.views if view.depth is not None]
    ratio = torch.cat([torch.zeros(0), *ratios])
    mend = "check that depth is along the optical axis of these frames, or take depth_file_path out; it is not used"
    if len(ratio) > _ENOUGH_POINTS and ratio.quantile(0.75) < _ONE_UNIT * ratio.quantile(0.25):
        unit = float(ratio.median()) * next(frame.depth_unit for frame in one.frames if frame.depth is not None)
        mend = f"by the silhouettes depth_unit_scale_factor would be about {unit:.2g}; until it is, depth is not used"
    found = f"other frames confirm {measured.confirmed:.0%} of the frames' depth"
    yield Problem("warning", capture.path / one.state.name, found, mend)


def _depth_ratio(view: View, points: Tensor, size: float) -> Tensor:
    """How many times deeper than its depth image says a view sees those of a hull's points [N, 3] that it sees."""
    column, row, depth, _ = project(view, points)
    told = view.depth[row, column]
    known = (visible(view, points, size) if len(points) else torch.zeros(0, dtype=torch.bool)) & (told > 0)
    return depth[known] / told[known]


def _check_outlines(capture: Capture, one: _Evidence) -> Iterator[Problem]:
    """Labels whose outline is not the silhouette's."""
    bands: list[tuple[Frame, float]] = []
    for frame, view in zip(one.frames, one.views, strict=True):
        if view.labels is None or view.alpha is None:
            continue
        inside = view.alpha > 127
        known = view.labels != UNLABELLED
        edge = float((inside[1:] != inside[:-1]).sum() + (inside[:, 1:] != inside[:, :-1]).sum())
        if edge and inside.any():
            differ = float((((view.labels > 0) != inside) & known).sum())
            bands.append((frame, differ / edge / math.sqrt(float(inside.sum()))))
    usual = float(np.median([band for _, band in bands])) if bands else 0.0
    if usual > _WIDE_BAND:
        found = f"the outlines of labels and silhouettes lie {usual:.1%} of the object's size apart"
        mend = "label up to the object's edge, or correct the masks"
        yield Problem("warning", capture.path / one.state.name, found, mend)
    for frame, band in bands:
        if band > max(_SHIFTED_BAND, 4 * usual):
            found = f"the labels of {frame.name} do not fit its silhouette"
            yield Problem("warning", frame.labels, found, "label it again, or take its semantics_path out")


# ---------------------------------------------------------------------------------------------- labels


def _check_votes(capture: Capture, one: _Evidence) -> Iterator[Problem]:
    """Labels that contradict the other frames', the worst first; what is wrong has no vote on the next."""
    frames = {id(b): f for f, b in zip((f for f in one.frames if f.labels is not None), one.votes.ballots, strict=True)}

    def worst(ballot: Ballot) -> tuple[float, float, str]:
        """How far beyond the limit the frame contradicts the others, the share, and of what."""
        share, number = (x[list(capture.parts)] for x in one.votes.disagreement(ballot))
        known = [
            (float(share[k]) / _WRONG_PART, float(share[k]), f"part {name}")
            for k, name in enumerate(capture.parts.values())
            if number[k] >= _ENOUGH_POINTS
        ]
        if number.sum() >= _ENOUGH_POINTS:
            whole = float((share * number).sum() / number.sum())
            strict = len(one.votes.ballots) >= _ENOUGH_BALLOTS and len(one.views) >= _ENOUGH_VIEWS
            limit = _WRONG_OBJECT if strict else _WRONG_PART
            known.append((whole / limit, whole, "object"))
        return max(known, default=(0.0, 0.0, ""))

    for _ in range(min(_MOST_WRONG, len(one.votes.ballots))):
        (beyond, share, what), ballot = max(((worst(b), b) for b in one.votes.ballots), key=lambda pair: pair[0])
        if beyond <= 1:
            return
        frame = frames[id(ballot)]
        one.votes = one.votes.without(ballot)
        found = f"the labels of {frame.name} contradict the other frames on {share:.0%} of the {what}"
        yield Problem("warning", frame.labels, found, "label it again, or take its semantics_path out")


def _shows(view: View, part: int) -> bool:
    return bool((view.labels == part).any())


def _coverage(one: _Evidence, part: int, name: str) -> Coverage:
    labelled = one.labelled_for_training
    return Coverage(one.state.name, name, sum(_shows(view, part) for view in labelled), len(labelled))


def _check_coverage(capture: Capture, one: _Evidence) -> Iterator[Problem]:
    for i, name in capture.parts.items():
        count = sum(_shows(view, i) for view in one.labelled_for_training)
        if 0 < count < _FEW_FRAMES:
            found = f"part {i} ({name}) is seen in {count} labelled training frame" + "s" * (count > 1)
            mend = "label more frames that show it; `splatart check --suggest 3` names some"
            yield Problem("warning", capture.path / one.state.name, found, mend)


# ---------------------------------------------------------------------------------------------- states


def _same_images(a: State, b: State) -> bool:
    """Whether the images of two states, in their order, are the same byte by byte."""
    pairs = zip(a.frames, b.frames, strict=False)
    try:
        return len(a.frames) == len(b.frames) and all(cmp(x.image, y.image, shallow=False) for x, y in pairs)
    except OSError:  # `check_capture` has told
        return False


def _read_there(a: _Evidence, b: _Evidence, num_parts: int) -> tuple[Ballot, ...]:
    """What the labels of state b say of the surface of a, whose points come before those of b. What lies behind the
    surface of b may be there, hidden by a part that moved before it, and has no vote."""
    points, size = a.points_in(b)
    return read_ballots(b.labelled, torch.cat([points, b.points]), max(size, b.size), num_parts)


def _in_place(a: _Evidence, b: _Evidence, there: Sequence[Ballot], num_parts: int) -> Tensor:
    """How much of each part of state a is at the same place in the labels of b, as a share of what is so in those of a,
    if what is not sure is elsewhere, and if it does not count: [2, P + 1]; NaN where few points are seen."""
    own, others = a.votes.parts(), b.votes.parts()
    # What b shows in the place of a part lies on its own surface.
    surface = (own, torch.cat([torch.zeros_like(own), others]))
    parts = torch.cat([own, others])
    right, number = torch.zeros(2, 1, num_parts + 1), torch.zeros(2, 2, num_parts + 1)
    for k, ballots in enumerate((a.votes.ballots, there)):
        for ballot in ballots:
            part, seen = parts[ballot.points], ballot.points < len(own)
            says, denies = ballot.verdict(part, surface[k])
            right[k] += torch.bincount(part[says & seen], minlength=num_parts + 1)
            number[k, 0] += torch.bincount(part[seen], minlength=num_parts + 1)
            number[k, 1] += torch.bincount(part[(says | denies) & seen], minlength=num_parts + 1)
    share = right / number
    return torch.where((number >= _ENOUGH_POINTS).all(0), share[1] / share[0], math.nan)


def _labelled_there(a: _Evidence, there: Sequence[Ballot], num_parts: int) -> Tensor:
    """Of each part of state a that the labels of b see in its place, how much they say is each part: [P + 1, P + 1]; 0
    where few points are seen."""
    own = a.votes.parts()
    number = torch.zeros(num_parts + 1, num_parts + 1)
    for ballot in there:
        seen = ballot.points < len(own)
        at = own[ballot.points[seen]], ballot.label[seen]
        number.index_put_(at, torch.ones(len(at[0])), accumulate=True)
    whole = number.sum(1, keepdim=True)
    return torch.where(whole >= _ENOUGH_POINTS, number / whole.clamp_min(1), 0.0)


def _check_motion(capture: Capture, first: _Evidence, other: _Evidence) -> Iterator[Problem]:
    if not capture.parts or first.votes is None or other.votes is None:
        return
    parts = list(capture.parts)
    place, num_parts = capture.path / other.state.name, max(parts)
    there = _read_there(first, other, num_parts)
    back = _read_there(other, first, num_parts)
    # A part that moved away shows another one behind it, but that one's place was not labelled as it before.
    same = torch.minimum(_labelled_there(first, there, num_parts), _labelled_there(other, back, num_parts).T)
    same = same[parts][:, parts]
    swapped = same - torch.maximum(same.diag()[:, None], same.diag())
    if bool((swapped > _OTHER_ID).any()):
        here, then = (parts[i] for i in divmod(int(swapped.argmax()), len(parts)))
        found = f"what is part {here} ({capture.parts[here]}) in {first.state.name} is labelled {then}"
        found += f" ({capture.parts[then]}) here"
        yield Problem("warning", place, found, "give each part the same id in all states")
        return
    in_place = [_in_place(first, other, there, num_parts), _in_place(other, first, back, num_parts)]
    both = torch.stack(in_place)[..., parts]
    # The less, as a part that comes out of another is seen where it was, but was not where it is seen.
    rest = both[:, 0].amin(0)
    moved = both[:, 1].nan_to_num(math.inf).amin(0)
    moved = moved[moved.isfinite()]
    if len(parts) > 1 and bool((rest > _STAYS).all()):
        found = f"no part seems to have moved since {first.state.name}"
        yield Problem(
            "warning", place, found, "show another configuration, or check the poses; a round part may have turned"
        )
    if 2 * len(moved) > len(parts) and bool((moved < _MOVES).all()):
        found = f"no part is where it was in {first.state.name}: the states may have different worlds or labels"
        mend = f"{OTHER_WORLDS_MEND}, or correct the ids of the parts"
        yield Problem("warning", place, found, mend)


def _check_sizes(capture: Capture, first: _Evidence, other: _Evidence) -> Iterator[Problem]:
    """A rigid part is as large in all states: where none is, lengths on the images are not what they are told to be."""
    if not capture.parts or first.votes is None or other.votes is None:
        return
    times = other.part_sizes(list(capture.parts)) / first.part_sizes(list(capture.parts))
    times = times[times.isfinite()]
    differ = len(times) > 1 and bool((times > _OTHER_SIZE).all() or (times < 1 / _OTHER_SIZE).all())
    # Of a part that labelled frames show from one side alone, more may be in sight in one state.
    if differ and min(first.shown_by_labels(), other.shown_by_labels()) > _LABELS_SHOW:
        found = f"parts measure {float(times.median()):.2f} times what they do in {first.state.name}"
        mend = (
            f"correct the fl_x and fl_y of one of the two: another lens, or another resolution; or {OTHER_WORLDS_MEND}"
        )
        yield Problem("warning", capture.path / other.state.name, found, mend)


# ---------------------------------------------------------------------------------------------- what to label next


def _suggest(evidence: Sequence[_Evidence], num_parts: int, count: int) -> Iterator[Frame]:
    candidates: list[tuple[Frame, int, Tensor]] = []
    gains = []
    for k, one in enumerate(evidence):
        part = torch.zeros(len(one.points), dtype=torch.long) if one.votes is None else one.votes.parts()
        weight = 1.0 / torch.bincount(part, minlength=num_parts + 1).clamp_min(1)[part]
        times = torch.zeros(len(one.points))
        for frame, view in zip(one.frames, one.views, strict=True):
            seen = visible(view, one.points, one.size)
            if view.labels is not None:
                times += seen
            elif frame.split == "train":
                candidates.append((frame, k, seen))
        gains.append(weight * 0.5 ** (times + 1))
    while count > 0 and candidates:
        best = max(range(len(candidates)), key=lambda i: float(gains[candidates[i][1]][candidates[i][2]].sum()))
        frame, k, seen = candidates.pop(best)
        gains[k] = torch.where(seen, gains[k] / 2, gains[k])
        count -= 1
        yield frame
