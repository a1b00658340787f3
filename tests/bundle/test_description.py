from splatart_ns.bundle.description import describe, describe_joint, part_depths


def test_parts_follow_what_they_hang_on(bundle):
    assert part_depths(bundle) == [("base", 0), ("door", 1), ("latch", 2)]
    slide, hinge, _ = bundle.joints
    slide.parent = "base"
    assert part_depths(bundle) == [("base", 0), ("latch", 1), ("door", 1)]
    bundle.joints.remove(hinge)
    assert part_depths(bundle) == [("base", 0), ("latch", 1), ("door", 0)]


def test_a_joint_says_how_certain_its_axis_and_its_parent_are(bundle):
    slide, hinge, _ = bundle.joints
    assert describe_joint(hinge) == "revolute on base or latch"
    hinge.covariance["axis"] = [[1e-4, 0, 0], [0, 1e-6, 0], [0, 0, 0]]
    hinge.ambiguous = True
    assert describe_joint(hinge) == "revolute on base or latch, ambiguous, axis ± 0.57 degree"
    hinge.alternatives.clear()
    assert describe_joint(hinge) == "revolute on base, ambiguous, axis ± 0.57 degree"
    assert describe_joint(slide) == "prismatic on door"
    hinge.covariance["axis"] = [[4.0, 0, 0], [0, 1e-6, 0], [0, 0, 0]]
    assert describe_joint(hinge) == "revolute on base, ambiguous, axis unknown"


def test_every_part_has_a_line_under_what_it_hangs_on_and_every_loop_one_at_the_end(bundle):
    slide, hinge, _ = bundle.joints
    hinge.alternatives.clear()
    first, *others = describe(bundle)
    assert first == "base: the root"
    assert others == [
        "  door: revolute on base; range 0 to 90 degree",
        "    latch: prismatic on door; range -0.25 to 0 metre",
        "base: spherical on latch, ambiguous; closes a loop",
    ]
    slide.type, slide.limits, slide.values = "cylindrical", None, slide.values[:, None].expand(-1, 2)
    turn = "range -14.32 to 0 degree"
    assert describe(bundle)[2] == f"    latch: cylindrical on door; range -0.25 to 0 metre; {turn}"
    hinge.in_tree = False
    assert "door: hangs on nothing" in describe(bundle)
