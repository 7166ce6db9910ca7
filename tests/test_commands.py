"""Every command that README.md, docs/ and examples/ tell people to type.

Each is read by the command line's own parser. The slow test types each of them in the root of a clone, once
with the package installed from it in place (`-e`) and once without.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import venv
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
import typer

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
WAYS = (r"dior-rt", r"python -m dior_rt", r"python -m tools\.\w+", r"accelerate launch -m dior_rt")
COMMAND = re.compile(rf"(?:^|&& )((?:{'|'.join(WAYS)})(?: [^&#|]*)?)(?=$|&|#|\|)")
#: Typed whole in a clone, because they are quick and need no extra: the rest is typed with --help.
QUICK = (
    "dior-rt relight examples/coffee.jpg examples/coffee-strokes.json -o relit.png",
    "dior-rt devices",
    "dior-rt info",
    "dior-rt estimate examples/coffee.jpg -o lumi.npy --steps 1",
    "dior-rt bench --quick --megapixels 0.02 --repeats 1 --steps 1 --device cpu --ops numpy",
    "python -m dior_rt --version",
    "python -m dior_rt bench --quick --megapixels 0.02 --repeats 1 --steps 1 --device cpu --ops numpy",
    "python -m tools.presets --cases 1",
)


def documented() -> dict[str, bool]:
    """The commands as they are typed, and whether they stand in a block of code, complete.

    In running text a command may lack its arguments. Synopses, with [brackets] or ..., are not typed.
    """
    found: dict[str, bool] = {}
    for page in PAGES:
        text = page.read_text("utf-8").replace("\\\n", " ")
        blocks = re.findall(r"^(?: {4,}|\$ )?(\S.*)$", text, re.MULTILINE)
        spans = [span.replace("\n", " ") for span in re.findall(r"`([^`]+)`", text)]
        for lines, complete in ((blocks, True), (spans, False)):
            for command in (command for line in lines for command in COMMAND.findall(line.strip())):
                words = command.split()
                if not set(command) & set("[]|<>") and "..." not in words:
                    found[" ".join(words)] = found.get(" ".join(words), False) or complete
    return found


COMMANDS = documented()


def parse(command: str) -> None:
    """Have the command line read its words, without doing anything. Raises what it raises."""
    # A letter stands for a number, as in --reach R.
    words = ["1" if re.fullmatch("[A-Z]", word) else word for word in shlex.split(command)]
    words = words[words.index("-m") + 1 :] if "-m" in words else words
    if words[0].startswith("tools."):
        app = typer.Typer()
        app.command()(import_module(words[0]).main)
        parser: Any = typer.main.get_command(app)
    else:
        from dior_rt.cli.app import app

        parser = typer.main.get_command(app)
    rest, context = words[1:], None
    while hasattr(parser, "resolve_command") and rest:
        context = parser.make_context(words[0], rest[:1], parent=context)
        _, parser, rest = parser.resolve_command(context, rest)
    if words[1:] and rest:
        parser.make_context(words[0], rest, parent=context)


def test_the_pages_have_commands() -> None:
    assert len(COMMANDS) > 30
    assert "dior-rt relight examples/coffee.jpg examples/coffee-strokes.json -o relit.png" in COMMANDS


@pytest.mark.parametrize(("command", "complete"), COMMANDS.items())
def test_a_documented_command_is_one(command: str, complete: bool) -> None:
    try:
        parse(command)
    except (
        typer.Exit,
        SystemExit,
    ):  # an option such as --install-completion does its work while it is parsed
        return
    except typer.TyperException as error:
        problem = error.format_message()
        if complete or not problem.startswith("Missing argument"):
            pytest.fail(f"{command}: {problem}")


@pytest.mark.parametrize(
    "command", ["dior-rt relight a b --magic", "dior-rt nothing", "dior-rt train fit a --bogus 1"]
)
def test_what_is_no_command_is_refused(command: str) -> None:
    with pytest.raises(typer.TyperException):
        parse(command)


@pytest.fixture(scope="module", params=["in place", "not in place"])
def clone(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A clone, and the commands of an environment that has the package installed from it.

    What the package needs is taken from the environment of the tests.
    """
    folder = tmp_path_factory.mktemp("clone")
    root, environment = folder / "dior", folder / "venv"
    ignored = shutil.ignore_patterns(
        "__pycache__", ".git", "build", "*.egg-info", "work", ".*_cache", "tests"
    )
    shutil.copytree(ROOT, root, ignore=ignored)
    venv.create(environment, with_pip=True)
    commands = environment / ("Scripts" if os.name == "nt" else "bin")
    pip = [commands / "python", "-m", "pip", "install", "--quiet", "--no-deps"]
    way = ["-e", root] if request.param == "in place" else [root]
    installing = subprocess.run([*pip, *way], capture_output=True, text=True)
    assert installing.returncode == 0, installing.stderr
    where = {"base": str(environment), "platbase": str(environment)}
    site = Path(sysconfig.get_path("purelib", vars=where))
    others = [place for place in sys.path if place.endswith("-packages")]
    (site / "zz-tests.pth").write_text("\n".join(others) + "\n")
    return root, commands


def type_in(clone: tuple[Path, Path], command: str) -> subprocess.CompletedProcess[str]:
    root, commands = clone
    words = shlex.split(command)
    if words[0] == "accelerate":
        words = ["python", *words[2:]]  # what each of its processes runs
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run(
        [commands / words[0], *words[1:]], cwd=root, env=environment, capture_output=True, text=True
    )


@pytest.mark.slow
@pytest.mark.parametrize("command", [*QUICK, *(f"{command} --help" for command in COMMANDS)])
def test_a_command_typed_in_a_clone_runs(clone: tuple[Path, Path], command: str) -> None:
    result = type_in(clone, command)
    assert result.returncode == 0, result.stderr
    assert "Traceback" not in result.stderr


@pytest.mark.slow
def test_kernels_export_and_training_are_found_in_a_clone(clone: tuple[Path, Path]) -> None:
    code = (
        "import multiprocessing\n"
        "import dior_rt.export.qwen.lora, dior_rt.training.scenes.shapes\n"
        "from dior_rt.kernels import NumpyOps\n"
        "if __name__ == '__main__':\n"
        "    with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "        print(type(pool.apply(NumpyOps)).__module__)\n"
    )
    (clone[0] / "check.py").write_text(code)
    result = type_in(clone, "python check.py")
    assert result.stdout.strip() == "dior_rt.kernels.numpy_ops", result.stderr
