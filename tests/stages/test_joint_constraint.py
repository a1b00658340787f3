import pytest

from splatart_ns.errors import InputError
from splatart_ns.stages.joint_constraint import JointConstraint, parse_constraints

NAMES = {1: "body", 2: "left", 3: "right"}


def test_the_users_word_on_joints_is_read():
    words = ["left:body=revolute", " right : left ", "right:body=none", "left:body=not-screw"]
    assert parse_constraints(words, NAMES) == [
        JointConstraint(1, 2, "revolute"),
        JointConstraint(2, 3),
        JointConstraint(1, 3, forbidden=True),
        JointConstraint(1, 2, "screw", forbidden=True),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["left"], "has no ':'"),
        (["left:door"], "called 'door'; there are body, left, right"),
        (["left:body="], "names no type; there are fixed, prismatic"),
        (["left:body=hinge"], "names no type"),
        (["left:left"], "with itself"),
        (["left:body", "left:right"], "two parents"),
        (["left:body=revolute", "left:body=screw"], "two types"),
        (["left:right", "right:left"], "circle"),
        (["left:body", "left:body=none"], "both required and forbidden"),
        (["left:body", "body:left=none"], "both required and forbidden"),
        (["left:body=screw", "left:body=not-screw"], "both required and forbidden"),
        (["body:left"], "hangs the root"),
    ],
)
def test_constraints_that_cannot_be_met_say_why(words, message):
    with pytest.raises(InputError, match=message):
        parse_constraints(words, NAMES, root=1)
