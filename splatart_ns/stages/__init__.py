"""The stages from labelled images to an articulated object: plain functions of plain data."""

from splatart_ns.stages.articulate import Joint, KinematicTree, forward_kinematics
from splatart_ns.stages.joint import fit_joint
from splatart_ns.stages.joint_fit import JointFit
from splatart_ns.stages.joint_pairs import fit_pairs
from splatart_ns.stages.tree import build_tree, choose_root, infer_tree

__all__ = [
    "Joint",
    "JointFit",
    "KinematicTree",
    "build_tree",
    "choose_root",
    "fit_joint",
    "fit_pairs",
    "forward_kinematics",
    "infer_tree",
]
