"""The user's defaults: file, environment, command line; and the shells' completion."""

from __future__ import annotations

import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from dior_rt.cli import app as commands
from dior_rt.cli import run
from dior_rt.cli.defaults import COMMANDS, SETTINGS, config_path, defaults_of, read_defaults, variable
from dior_rt.errors import InputError
from dior_rt.images.metadata import read_settings


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Return a function that writes the configuration file, which DIOR_CONFIG names."""
    monkeypatch.setenv("DIOR_CONFIG", str(tmp_path / "config.toml"))

    def write(text: str) -> Path:
        (tmp_path / "config.toml").write_text(text)
        return tmp_path / "config.toml"

    return write


def test_commands_over_all_variables_over_files(config, monkeypatch) -> None:
    config('steps = 3\npreset = "fast"\ninterval = [0.2, 0.9]\n[batch]\nsteps = 4\nat-once = 2\nquiet = true')
    assert defaults_of("relight", read_defaults()) == {
        "steps": "3",
        "preset": "fast",
        "interval": ["0.2", "0.9"],
    }
    batch = defaults_of("batch", read_defaults())
    assert (batch["steps"], batch["at_once"], batch["quiet"]) == ("4", "2", "true")
    monkeypatch.setenv("DIOR_STEPS", "5")
    assert defaults_of("batch", read_defaults())["steps"] == "5"


def test_the_result_follows_the_defaults_and_the_command_line(folder, model, config, monkeypatch) -> None:
    config("steps = 3\ninterval = [0.2, 0.9]\n[relight]\nquiet = true")
    call = ["relight", "photo.png", "strokes.png", *model]
    assert run([*call, "-o", "file.png"]) == 0
    assert run([*call, "-o", "line.png", "--steps", "1"]) == 0
    monkeypatch.setenv("DIOR_STEPS", "2")
    assert run([*call, "-o", "variable.png"]) == 0
    made = {name: read_settings(Path(f"{name}.png")) for name in ("file", "line", "variable")}
    assert {name: settings["steps"] for name, settings in made.items()} == {
        "file": 3,
        "line": 1,
        "variable": 2,
    }
    assert made["file"]["interval"] == [0.2, 0.9]


def test_info_shows_them(config, monkeypatch, capfd) -> None:
    path = config('preset = "fast"\n[batch]\nformat = "jpg"')
    monkeypatch.setenv("DIOR_SEED", "7")
    monkeypatch.setenv("DIOR_SPEED", "7")
    assert run(["info"]) == 0
    said = capfd.readouterr().out
    for line in (f"fast (from {path})", f"jpg (from {path})", "7 (from DIOR_SEED)", "no setting has this"):
        assert line in said
    assert run(["info", "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    assert report["config"] == str(path) and [d["setting"] for d in report["defaults"]] == [
        "preset",
        "format",
        "seed",
    ]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("steps = ", "Cannot read the configuration"),
        ("colour = 3", "'colour' is no setting"),
        ("[paint]\nsteps = 3", "no command [paint]"),
        ("steps = [1, 2]", "steps must be"),
        ('steps = "many"', "config.toml"),
    ],
)
def test_a_file_that_makes_no_sense_is_one_sentence(folder, config, capfd, text: str, words: str) -> None:
    config(text)
    assert run(["relight", "photo.png", "strokes.png"]) == 2
    said = capfd.readouterr().err
    assert words in said and said.count("\n") == 1


def test_where_the_file_is(tmp_path: Path) -> None:
    home = {"HOME": str(tmp_path)}
    if sys.platform != "win32":
        assert config_path(home) == tmp_path / ".config/dior-rt/config.toml"
        assert config_path({**home, "XDG_CONFIG_HOME": "/x"}) == Path("/x/dior-rt/config.toml")
    assert config_path({"DIOR_CONFIG": "mine.toml"}) == Path("mine.toml")
    assert read_defaults(home) == []
    with pytest.raises(InputError, match="no such file"):
        read_defaults({"DIOR_CONFIG": str(tmp_path / "none.toml")})


def test_every_setting_is_an_option_of_some_command() -> None:
    parameters = set()
    for name in COMMANDS:
        module = __import__(f"dior_rt.cli.{commands.COMMANDS[name]}", fromlist=[name])
        parameters |= set(inspect.signature(getattr(module, name)).parameters)
    assert {setting.replace("-", "_") for setting in SETTINGS} <= parameters
    assert variable("at-once") == "DIOR_AT_ONCE"


@pytest.mark.parametrize(
    ("words", "expected"),
    [("dior-rt re", {"relight"}), ("dior-rt batch --dry", {"--dry-run"})],
)
def test_bash_completes_commands_and_options(words: str, expected: set[str]) -> None:
    count = str(len(words.split()) - 1)
    environment = {"COMP_WORDS": words, "COMP_CWORD": count, "_DIOR_RT_COMPLETE": "complete_bash"}
    result = subprocess.run(
        [sys.executable, "-m", "dior_rt"], env={**os.environ, **environment}, capture_output=True, text=True
    )
    assert expected <= set(result.stdout.split()), result.stderr


def test_completion_is_offered_for_every_shell(capfd) -> None:
    assert run(["--help"]) == 0
    said = capfd.readouterr().out
    assert "--install-completion" in said and "--show-completion" in said
