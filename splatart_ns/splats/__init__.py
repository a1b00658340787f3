"""Sets of Gaussians, and their PLY files."""

from splatart_ns.splats.ply import read_ply, write_ply
from splatart_ns.splats.splat import Splat

__all__ = ["Splat", "read_ply", "write_ply"]
