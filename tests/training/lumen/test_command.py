"""The commands refuse what cannot be used, in one sentence, and leave nothing behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from dior_rt.cli import run


@pytest.mark.parametrize("command", ["pack", "fit"])
def test_an_empty_folder_is_refused(command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "in").mkdir()
    assert run(["train", "lumen", command, str(tmp_path / "in"), str(tmp_path / "out")]) == 2
    errors = capsys.readouterr().err
    assert len(errors.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_an_export_of_a_run_takes_no_lora(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "state.json").write_text("{}")
    assert run(["export", str(tmp_path), "--lora", "x", "-o", str(tmp_path / "bundle")]) == 2
    assert "takes no LoRA" in capsys.readouterr().err
