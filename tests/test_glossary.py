"""Check that identifiers use the words of the field and no private ones.

A private word is one that a newcomer cannot look up: `said` for the features of the strokes, `own` for the
source light. Each entry names the words to use instead.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("dior_rt", "kernels", "export", "training", "tools")

BANNED = {
    "aim": "target, goal or direction",
    "aimed": "directed",
    "choosy": "selective",
    "given": "features, condition or fixed",
    "heard": "received or read",
    "hears": "receives or reads",
    "hushed": "zeroed",
    "known": "source, visible or features",
    "loud": "non-zero or verbose",
    "mine": "the name of what it is",
    "murk": "noise or haze",
    "ours": "the name of what it is",
    "own": "source (light), default (setting) or local (names)",
    "said": "output, text or stroke features",
    "saying": "text or message",
    "says": "text or message",
    "silent": "zero-initialised or quiet",
    "tell": "print, report or identify",
    "theirs": "the name of what it is",
    "told": "options, features or condition",
}

#: Names of tensors in the graphs of bundles. They are part of the format.
TENSORS = {"own", "given", "GIVEN"}
TENSOR_FILES = (
    "dior_rt/families/lumen.py",
    "export/fused.py",
    "export/mini.py",
    "training/network/features.py",
    "training/network/model.py",
)

#: Identifiers that still wait for a new name. The list only ever gets shorter.
WAITING = {
    ("dior_rt/cli/__init__.py", "told"),
    ("dior_rt/images/exr.py", "_hushed"),
    ("dior_rt/images/exr.py", "given"),
    ("dior_rt/images/photo.py", "given"),
    ("dior_rt/images/primaries.py", "given"),
    ("dior_rt/images/sixteen_bit.py", "own"),
    ("dior_rt/images/strokes.py", "known"),
}


def identifiers(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and the name of everything that a module defines, binds or takes as an argument."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                yield node.lineno, node.name
            case ast.arg():
                yield node.lineno, node.arg
            case ast.Name(ctx=ast.Store()):
                yield node.lineno, node.id
            case ast.Attribute(ctx=ast.Store()):
                yield node.lineno, node.attr
            case ast.alias(asname=str() as name):
                yield 0, name


def words(identifier: str) -> list[str]:
    """Split snake_case and CamelCase into lower-case words."""
    return re.findall(r"[a-z]+|\d+", re.sub(r"([a-z0-9])([A-Z])", r"\1_\2", identifier).lower())


def private_words(source: str) -> list[tuple[int, str, str]]:
    """Return (line, identifier, banned word) for each identifier that uses a private word."""
    return [
        (line, name, word) for line, name in identifiers(source) for word in words(name) if word in BANNED
    ]


def allowed(file: str, name: str) -> bool:
    """Return whether an identifier may use a private word in a file."""
    return (file, name) in WAITING or (file in TENSOR_FILES and name in TENSORS)


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("said = 1", ["said"]),
        ("def f(own_light): pass", ["own"]),
        ("class WhatTold: pass", ["told"]),
        ("self.loud = 2", ["loud"]),
        ("import numpy as mine", ["mine"]),
        ("owner = unknown = aiming = 3", []),
        ("print(said)", []),  # a use; the definition is reported
    ],
)
def test_private_words_are_found(source: str, found: list[str]) -> None:
    assert [word for _, _, word in private_words(source)] == found


@pytest.mark.parametrize("folder", FOLDERS)
def test_identifiers_use_the_words_of_the_field(folder: str) -> None:
    problems = []
    for path in sorted((ROOT / folder).rglob("*.py")):
        file = path.relative_to(ROOT).as_posix()
        for line, name, word in private_words(path.read_text("utf-8")):
            if not allowed(file, name):
                problems.append(f"{file}:{line}: {name}: write {BANNED[word]} in place of {word!r}")
    assert not problems, "\n".join(problems)


def test_nothing_waits_that_has_a_new_name() -> None:
    for file, name in WAITING:
        assert name in {found for _, found in identifiers((ROOT / file).read_text("utf-8"))}, (file, name)
