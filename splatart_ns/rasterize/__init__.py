"""Gaussians to pixels: one entry, with backends for CUDA (gsplat), CPU (numba) and any device (torch)."""

from splatart_ns.rasterize.rasterization import default_backend, rasterization, rasterize_neighbours, set_backend
from splatart_ns.rasterize.render import Rendering, render

__all__ = ["Rendering", "default_backend", "rasterization", "rasterize_neighbours", "render", "set_backend"]
