"""Imports run one way, and nerfstudio stays behind the plugin."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

BELOW = {
    "errors": set(),
    "machine": set(),
    "plain_yaml": set(),
    "shape": set(),
    "threads": set(),
    "choices": {"errors"},
    "files": {"errors"},
    "records": {"errors", "shape"},
    "geometry": {"errors"},
    "splats": {"errors", "files", "geometry"},
    "rasterize": {"choices", "errors", "geometry", "splats", "threads"},
    "capture": {"choices", "errors", "files", "geometry", "machine", "plain_yaml", "shape"},
    "stages": {"capture", "errors", "geometry", "rasterize", "splats", "threads"},
}
BELOW["bundle"] = BELOW["stages"] | {"choices", "files", "records", "stages"}
BELOW["evaluation"] = BELOW["bundle"] | {"bundle"}
BELOW["viewer"] = BELOW["bundle"] | {"bundle"}
BELOW["plugin"] = BELOW["bundle"] | {"bundle", "machine", "plain_yaml", "shape"}
BELOW["batch"] = BELOW["plugin"] | {"plugin"}
BELOW["method_configs"] = {"plugin"}
BELOW["cli"] = {"batch", "bundle", "capture", "choices", "errors", "evaluation", "machine", "plugin", "rasterize"}
BELOW["cli"] |= {"viewer"}
"""What each part of the package may import of the others."""

ABOVE_THE_METHODS = {"splatart_ns/plugin/stage_configs.py": {"method_configs"}}
"""A fit runs the methods that are made of the plugin."""

FILES = sorted([*(ROOT / "splatart_ns").rglob("*.py"), *(ROOT / "method_configs").rglob("*.py")])


def imported(file):
    """Full names of all modules that a file imports, at the top or inside functions."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}, line {node.lineno}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def layer(file):
    top, second = file.relative_to(ROOT).parts[:2]
    return top if top == "method_configs" else second.removesuffix(".py")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_a_file_imports_only_what_lies_below_it(file):
    if file.parent.name == "splatart_ns" and file.name == "__init__.py":
        return
    own = layer(file)
    allowed = BELOW[own] | {own} | ABOVE_THE_METHODS.get(file.relative_to(ROOT).as_posix(), set())
    found = {name.split(".")[1] for name in imported(file) if name.split(".")[0] == "splatart_ns"}
    assert found <= allowed


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(ROOT).as_posix())
def test_only_the_plugin_and_the_methods_import_nerfstudio(file):
    if layer(file) not in ("plugin", "method_configs"):
        assert not [name for name in imported(file) if name.split(".")[0] == "nerfstudio"]


def test_every_part_of_the_package_has_its_place():
    assert {layer(file) for file in FILES} - {"__init__"} == set(BELOW)


@pytest.mark.parametrize("package", ["splatart_ns", "method_configs"])
def test_the_outer_packages_are_empty(package):
    assert (ROOT / package / "__init__.py").read_bytes() == b""


def test_the_command_line_starts_without_the_heavy_packages():
    heavy = {"torch", "nerfstudio", "numba", "kornia", "trimesh", "cv2", "scipy"}
    code = f"import sys, splatart_ns.cli; print(*{heavy} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"
