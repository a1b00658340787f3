import pytest
import torch
from part_scene import angle_deg, box, motion, photograph, two_states

from splatart_ns.splats.splat import Splat
from splatart_ns.stages.initial_motion import InitialMotion
from splatart_ns.stages.neighbours import turned_as_neighbours_let
from splatart_ns.stages.part_pair import PartPair

EYE = torch.eye(4, dtype=torch.float64)
RESTS = InitialMotion(EYE, found=True, still=True)
CENTRE = torch.tensor([0.1, 0.0, -0.09], dtype=torch.float64)
"""Of the knob."""
BASE, KNOB = (1, (0.9, 0.6, 0.3), (0.0, 0.0, -0.3)), (2, (0.3, 0.2, 0.12), tuple(CENTRE.tolist()))


def about(T, centre):
    """T as it turns about this point."""
    T = T.clone()
    T[:3, 3] += centre - T[:3, :3] @ centre
    return T


def over(T):
    """The knob upside down where T brings it."""
    return T @ about(motion((180, 0, 0), (0, 0, 0)), CENTRE)


@pytest.fixture(scope="module")
def knob():
    """A grey knob on a grey base that turns about itself, and by what."""
    T = about(motion((0, 0, 25), (0, 0, 0)), CENTRE)
    base, knob = (box(part, size, centre, 0.04) for part, size, centre in (BASE, KNOB))
    base.sh, knob.sh = (torch.zeros_like(splat.sh) for splat in (base, knob))
    splats = Splat.cat([base, knob]), Splat.cat([base, knob.transformed(T)])
    return splats, tuple(photograph(s) for s in splats), T


def test_of_motions_that_look_alike_a_part_makes_the_one_that_does_not_turn_it_over(knob):
    *scene, T = knob
    found = turned_as_neighbours_let(*scene, {1: RESTS, 2: InitialMotion(over(T), found=True, alike=(T,))})
    assert torch.equal(found[2].T, T) and torch.equal(found[2].alike[0], over(T))
    assert found[1] is RESTS


def test_a_motion_that_registration_missed_is_found_by_how_the_part_is_symmetric(knob):
    *scene, T = knob
    found = turned_as_neighbours_let(*scene, {1: RESTS, 2: InitialMotion(over(T), found=True)})[2]
    assert angle_deg(found.T, T) < 1 and (found.T - T)[:3, 3].norm() < 0.01
    assert len(found.alike) == 1 and torch.equal(found.alike[0], over(T))


def test_a_part_that_looks_otherwise_is_left_turned_over():
    T = motion((0, 0, 120), (0.1, 0.0, 0.0))  # so it did turn: its faces and their halves are of other colours
    found = turned_as_neighbours_let(*two_states(T), {1: RESTS, 2: InitialMotion(T, found=True)})
    assert torch.equal(found[2].T, T) and found[2].alike == ()


@pytest.mark.parametrize("own_cost", [0.0, 1.0])
def test_a_motion_that_fits_no_worse_than_the_states_own_gaussians_counts_as_alike(monkeypatch, own_cost):
    """By how a flange, half of it hidden, fits better turned over, it fits better than its own Gaussians do."""
    T = about(motion((0, 0, 25), (0, 0, 0)), CENTRE)
    base, coloured = (box(part, size, centre, 0.04) for part, size, centre in (BASE, KNOB))
    splats = Splat.cat([base, coloured]), Splat.cat([base, coloured.transformed(over(T))])
    monkeypatch.setattr(PartPair, "own_cost", lambda pair: own_cost)
    motions = {1: RESTS, 2: InitialMotion(over(T), found=True)}
    found = turned_as_neighbours_let(splats, tuple(photograph(s) for s in splats), motions)[2]
    assert (angle_deg(found.T, T) < 45) == (own_cost > 0)  # as it refines on colours that do not fit
    assert len(found.alike) == (own_cost > 0)


def test_a_door_opens_about_its_hinge_where_it_looks_alike_turned_about_its_middle():
    post, door = box(1, (0.2, 1.0, 0.2), (-0.6, 0.0, 0.0)), box(2, (1.0, 1.0, 0.06), (0.0, 0.0, 0.0))
    T = about(motion((0, 30, 0), (0, 0, 0)), torch.tensor([-0.5, 0.0, 0.0]).double())
    other = motion((0, 0, 70), (0, 0, 0))
    states = Splat.cat([post, door]), Splat.cat([post, door.transformed(T)])
    for motions in ((other, T), (T, other)):
        found = turned_as_neighbours_let(
            states, ([], []), {1: RESTS, 2: InitialMotion(motions[0], found=True, alike=motions[1:])}
        )[2]
        assert torch.equal(found.T, T) and torch.equal(found.alike[0], other)


def test_a_pane_opens_about_its_hinge_where_it_looks_alike_turned_about_the_middle_of_its_frame():
    sides = [((0.1, 1.2, 0.1), (x, 0.0, 0.0)) for x in (-0.6, 0.6)] + [
        ((1.2, 0.1, 0.1), (0.0, y, 0.0)) for y in (-0.6, 0.6)
    ]
    frame = Splat.cat([box(1, *side) for side in sides])
    pane = box(2, (1.0, 1.0, 0.06), (0.0, 0.0, 0.0))
    T = about(motion((0, 30, 0), (0, 0, 0)), torch.tensor([-0.5, 0.0, 0.0]).double())
    states = Splat.cat([frame, pane]), Splat.cat([frame, pane.transformed(T)])
    motions = {1: RESTS, 2: InitialMotion(motion((0, 0, 70), (0, 0, 0)), found=True, alike=(T,))}
    assert torch.equal(turned_as_neighbours_let(states, ([], []), motions)[2].T, T)


def test_no_motion_is_taken_that_neither_slides_nor_turns_about_a_hinge_of_both(knob):
    *scene, T = knob
    screw = about(motion((0, 0, 25), (0, 0, 0.5)), CENTRE)
    motions = {1: RESTS, 2: InitialMotion(over(T), found=True, alike=(screw,))}
    found = turned_as_neighbours_let(scene[0], ([], []), motions)  # without views nothing else is found
    assert torch.equal(found[2].T, over(T))


def test_what_slides_past_all_that_rests_need_not_move_as_what_it_touches():
    body = box(1, (0.5, 0.5, 0.5), (0.0, 1.0, 0.0), num_parts=3)
    other, drawer = (box(part, (0.3, 0.1, 0.3), (0.3 * part, 0.0, 0.0), num_parts=3) for part in (2, 3))
    turned, slide = motion((0, 0, 80), (0.1, 0.0, 0.0)), motion((0, 0, 0), (0.0, -0.3, 0.0))
    states = Splat.cat([body, other, drawer]), Splat.cat([body, other, drawer.transformed(slide)])
    motions = {
        1: RESTS,
        2: InitialMotion(turned, found=True),
        3: InitialMotion(slide, found=True, alike=(turned @ motion((0, 0, 5), (0, 0, 0)),)),
    }
    assert torch.equal(turned_as_neighbours_let(states, ([], []), motions)[3].T, slide)


def test_a_part_is_judged_against_what_it_touches_and_that_first():
    """A link that turns by 160 degrees hangs on one that turns by 80; both are in doubt."""
    root, arm, hand = (box(part, (0.5, 0.2, 0.2), (0.5 * part, 0.0, 0.0), num_parts=3) for part in (1, 2, 3))

    def turn(degrees, x):
        return about(motion((0, 0, degrees), (0, 0, 0)), torch.tensor([x, 0.1, 0.0]).double())

    first = turn(80, 0.75)
    second = first @ turn(80, 1.25)
    states = Splat.cat([root, arm, hand]), Splat.cat([root, arm.transformed(first), hand.transformed(second)])
    motions = {
        3: InitialMotion(second, found=True, alike=(second @ turn(150, 1.25),)),
        2: InitialMotion(turn(140, 0.75), found=True, alike=(first,)),
        1: RESTS,
    }
    found = turned_as_neighbours_let(states, ([], []), motions)
    assert torch.equal(found[2].T, first) and torch.equal(found[3].T, second)
    alone = {2: motions[2], 3: InitialMotion(second, found=False)}
    assert turned_as_neighbours_let(states, ([], []), alone) == alone


def test_a_part_that_is_not_in_doubt_stays_so_beside_one_that_is():
    """An elbow further from the shoulder than from the forearm, that looks alike turned over against it."""
    places = {1: 0.0, 2: 0.5, 3: 1.2, 4: 1.7}
    parts = {part: box(part, (0.5, 0.2, 0.2), (x, 0.0, 0.0), num_parts=4) for part, x in places.items()}
    elbow = about(motion((0, 0, 60), (0, 0, 0)), torch.tensor([1.0, 0.1, 0.0]).double())
    forearm = elbow @ about(motion((0, 0, 50), (0, 0, 0)), torch.tensor([1.45, 0.1, 0.0]).double())
    over = forearm @ about(motion((180, 0, 0), (0, 0, 0)), torch.tensor([1.7, 0.0, 0.0]).double())
    moved = {1: parts[1], 2: parts[2], 3: parts[3].transformed(elbow), 4: parts[4].transformed(forearm)}
    motions = {
        1: RESTS,
        2: RESTS,
        3: InitialMotion(elbow, found=True),
        4: InitialMotion(over, found=True, alike=(forearm,)),
    }
    states = Splat.cat(list(parts.values())), Splat.cat(list(moved.values()))
    found = turned_as_neighbours_let(states, ([], []), motions)
    assert torch.equal(found[3].T, elbow) and torch.equal(found[4].T, forearm)


def test_a_part_beside_others_in_doubt_waits_for_what_they_turn_out_to_do():
    """A plain wrist that fits best turned over, on a forearm that is in doubt until the arm has told how it moves."""
    places = {1: 0.0, 2: 0.5, 3: 0.9}
    sizes = {1: (0.5, 0.3, 0.2), 2: (0.5, 0.3, 0.2), 3: (0.3, 0.2, 0.12)}
    arm, forearm, wrist = (box(part, sizes[part], (x, 0.0, 0.0), 0.04, num_parts=3) for part, x in places.items())
    wrist.sh = torch.zeros_like(wrist.sh)
    first = about(motion((0, 0, 40), (0, 0, 0)), torch.tensor([0.25, 0.1, 0.0]).double())
    second = first @ about(motion((0, 0, 50), (0, 0, 0)), torch.tensor([0.75, 0.1, 0.0]).double())
    centre = torch.tensor([0.9, 0.0, 0.0]).double()
    over = second @ about(motion((180, 0, 0), (0, 0, 0)), centre)
    states = Splat.cat([arm, forearm, wrist]), Splat.cat([arm, forearm.transformed(first), wrist.transformed(second)])
    motions = {
        1: RESTS,
        2: InitialMotion(first @ over, found=True, alike=(first,)),
        3: InitialMotion(over, found=True),
    }
    found = turned_as_neighbours_let(states, tuple(photograph(s) for s in states), motions)
    assert torch.equal(found[2].T, first)
    assert angle_deg(found[3].T, second) < 1 and torch.equal(found[3].alike[0], over)


def test_a_part_between_two_moves_against_both():
    """A hip that may have turned by more or less against the body; the leg hangs on it."""
    places = {1: 0.0, 2: 0.5, 3: 1.0, 4: 1.5}
    body, hip, leg, foot = (box(part, (0.5, 0.2, 0.2), (x, 0.0, 0.0), num_parts=4) for part, x in places.items())

    def turn(degrees, x):
        return about(motion((0, 0, degrees), (0, 0, 0)), torch.tensor([x, 0.1, 0.0]).double())

    right = turn(40, 0.25)
    thigh = right @ about(motion((35, 0, 0), (0, 0, 0)), torch.tensor([0.75, 0.0, 0.0]).double())
    shin = thigh @ turn(20, 1.25)
    moved = [hip.transformed(right), leg.transformed(thigh), foot.transformed(shin)]
    motions = {
        1: RESTS,
        2: InitialMotion(turn(80, 0.25), found=True, alike=(right,)),
        3: InitialMotion(thigh, found=True),
        4: InitialMotion(shin, found=True),
    }
    states = Splat.cat([body, hip, leg, foot]), Splat.cat([body, *moved])
    found = turned_as_neighbours_let(states, ([], []), motions)
    assert torch.equal(found[2].T, right) and torch.equal(found[3].T, thigh)


@pytest.mark.parametrize("hinge, opened", [(5.0, True), (0.65, False)], ids=["beside the object", "a little off"])
def test_a_lid_opens_by_more_than_a_right_angle_where_else_it_would_turn_about_a_line_beside_the_object(hinge, opened):
    book, lid = box(1, (1.0, 0.8, 0.1), (0.0, 0.0, 0.0)), box(2, (1.0, 0.8, 0.06), (0.0, 0.0, 0.1))
    T = about(motion((170, 0, 0), (0, 0, 0)), torch.tensor([0.0, -0.4, 0.07]).double())
    first = about(motion((0, 10, 0), (0, 0, 0)), torch.tensor([hinge, 0.0, 0.0]).double())
    states = Splat.cat([book, lid]), Splat.cat([book, lid.transformed(T)])
    motions = {1: RESTS, 2: InitialMotion(first, found=True, alike=(T,))}
    assert torch.equal(turned_as_neighbours_let(states, ([], []), motions)[2].T, T if opened else first)


def test_an_arm_that_makes_no_joint_with_the_base_it_lies_on_waits_for_the_arm_that_carries_it():
    post, board = ((0.4, 0.4, 0.1), (-0.4, 0.0, 0.0), 0.03), ((1.2, 1.2, 0.1), (0.7, 0.6, 0.0), 0.1)
    base = Splat.cat([box(1, *place, num_parts=3) for place in (post, board)])
    first, second = (box(part, (0.8, 0.15, 0.1), (x, 0.0, 0.1), num_parts=3) for part, x in ((2, 0.0), (3, 0.8)))
    carried = about(motion((0, 0, 30), (0, 0, 0)), torch.tensor([-0.4, 0.0, 0.1]).double())
    T = carried @ about(motion((0, 0, 20), (0, 0, 0)), torch.tensor([0.4, 0.0, 0.1]).double())
    wrong = T @ about(motion((0, 180, 0), (0, 0, 0)), torch.tensor([0.8, 0.2, 0.1]).double())
    states = Splat.cat([base, first, second]), Splat.cat([base, first.transformed(carried), second.transformed(T)])
    motions = {
        1: RESTS,
        2: InitialMotion(carried, found=True, alike=(carried @ motion((0, 0, 180), (0, 0, 0)),)),
        3: InitialMotion(wrong, found=True, alike=(T,)),
    }
    found = turned_as_neighbours_let(states, ([], []), motions)
    assert torch.equal(found[2].T, carried) and torch.equal(found[3].T, T)
