"""Small files to find and match."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make files of given names, with their name as content, in the working folder."""
    monkeypatch.chdir(tmp_path)

    def write(*names: str) -> None:
        for name in names:
            path = Path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(name)

    return write
