"""The layout of the code: which module imports which.

kernels -> dior_rt -> training -> export -> tools, where an arrow means "is used by". Imports inside functions
are free to go the other way: the command line loads training and export when a command needs them.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ORDER = ("kernels", "dior_rt", "training", "export", "tools")
EXTRAS = [
    "torch",
    "onnx",
    "onnxscript",
    "safetensors",
    "peft",
    "accelerate",
    "mitsuba",
    "diffusers",
    "transformers",
]


@cache
def modules() -> dict[str, Path]:
    """Name by which a module is imported -> its file."""
    found = {}
    for folder in ORDER:
        for file in (ROOT / folder).rglob("*.py"):
            parts = file.relative_to(ROOT).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join(parts if folder in ("dior_rt", "tools") else ("dior_rt", *parts))] = file
    return found


def rank(name: str) -> int:
    return ORDER.index(modules()[name].relative_to(ROOT).parts[0])


def imports_of(tree: ast.AST, everywhere: bool) -> Iterator[ast.Import | ast.ImportFrom]:
    """The imports of a module; with `everywhere` also those inside functions and for type checkers."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif everywhere or not (
            isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
            or (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
        ):
            yield from imports_of(node, everywhere)


@cache
def graph(everywhere: bool) -> dict[str, set[str]]:
    """Module -> the modules of this project that it imports."""
    edges: dict[str, set[str]] = {}
    for name, file in modules().items():
        edges[name] = set()
        for node in imports_of(ast.parse(file.read_text("utf-8")), everywhere):
            if isinstance(node, ast.Import):
                targets = [alias.name for alias in node.names]
            else:
                assert node.level == 0, f"{name} has a relative import"
                module = str(node.module)
                targets = [f"{module}.{alias.name}" for alias in node.names]
                targets = [target if target in modules() else module for target in targets]
            edges[name] |= {target for target in targets if target in modules() and target != name}
    return edges


def circles(edges: dict[str, set[str]]) -> list[set[str]]:
    """The sets of modules that reach one another (Tarjan's strongly connected components)."""
    number: dict[str, int] = {}
    lowest: dict[str, int] = {}
    path: list[str] = []
    found: list[set[str]] = []

    def visit(name: str) -> None:
        number[name] = lowest[name] = len(number)
        path.append(name)
        for other in edges[name]:
            if other not in number:
                visit(other)
            if other in path:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == number[name]:
            circle = set(path[path.index(name) :])
            del path[path.index(name) :]
            if len(circle) > 1:
                found.append(circle)

    for name in edges:
        if name not in number:
            visit(name)
    return found


def test_circles_are_found() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == [{"b", "c"}]


def test_modules_import_downwards_only() -> None:
    upwards = [
        f"{name} imports {other}"
        for name, others in graph(everywhere=False).items()
        for other in others
        if rank(other) > rank(name)
    ]
    assert upwards == []


def test_there_are_no_circles() -> None:
    assert circles(graph(everywhere=False)) == []


@pytest.mark.parametrize("folder", ["kernels", "training", "export"])
def test_there_are_no_circles_even_inside_functions(folder: str) -> None:
    prefix = f"dior_rt.{folder}."
    edges = {
        name: {other for other in others if other.startswith(prefix)}
        for name, others in graph(everywhere=True).items()
        if name.startswith(prefix)
    }
    assert circles(edges) == []


def test_only_the_command_line_knows_training_and_export() -> None:
    """Even inside functions: the runtime is a library that does not know what was built on it."""
    knows = {
        name
        for name, others in graph(everywhere=True).items()
        if rank(name) <= ORDER.index("dior_rt")
        for other in others
        if rank(other) > ORDER.index("dior_rt") and not name.startswith("dior_rt.cli.")
    }
    assert knows == set()


def test_only_the_entry_points_import_the_command_line() -> None:
    users = {
        name
        for name, others in graph(everywhere=True).items()
        if not name.startswith(("dior_rt.cli", "tools."))
        for other in others
        if other.startswith("dior_rt.cli")
    }
    assert users <= {"dior_rt.__main__"}


def test_relight_names_no_family() -> None:
    text = (ROOT / "dior_rt" / "relight.py").read_text("utf-8")
    assert not [word for word in ("mini", "qwen", "Mini", "Qwen", "grid is None") if word in text]


def test_the_runtime_loads_without_the_extras() -> None:
    others = ("dior_rt.__main__", "dior_rt.batch.ray_engine")  # the second is imported for --engine ray alone
    runtime = [name for name in modules() if rank(name) <= 1 and name not in others]
    code = (
        "import importlib, sys\n"
        f"for name in {runtime!r}: importlib.import_module(name)\n"
        f"print([name for name in {EXTRAS!r} if name in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stdout + result.stderr


def test_every_package_is_in_the_wheel() -> None:
    import tomllib

    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    expected = {name for name, file in modules().items() if file.name == "__init__.py"}
    assert {name for name in expected if not name.startswith("tools")} == set(packages)
