"""The commands by name. Each is imported, and its options are built, when it is requested."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from dior_rt import __version__
from dior_rt.extras import needs_extra

STYLE: dict[str, Any] = {
    "rich_markup_mode": None,
    "pretty_exceptions_enable": False,
    "context_settings": {"help_option_names": ["-h", "--help"]},
}
#: The module of dior_rt.cli that holds each command.
COMMANDS = {
    "relight": "pictures",
    "batch": "batch",
    "estimate": "pictures",
    "sparsify": "pictures",
    "desk": "desk",
    "devices": "about",
    "info": "about",
    "bench": "bench",
    "export": "convert",
}


class Commands(TyperGroup):
    """The group of COMMANDS and of the groups that the app adds."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands."""
        return [*COMMANDS, *super().list_commands(ctx)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, or None."""
        if cmd_name not in COMMANDS:
            return super().get_command(ctx, cmd_name)
        body = getattr(import_module(f"dior_rt.cli.{COMMANDS[cmd_name]}"), cmd_name)
        alone = typer.Typer(add_completion=False, **STYLE)
        alone.command(cmd_name)(body)
        return typer.main.get_command(alone)

    def invoke(self, ctx: Any) -> Any:
        """Run a command with the user's defaults."""
        from dior_rt.cli.defaults import COMMANDS, Default, defaults_of, read_defaults

        defaults = read_defaults()
        ctx.default_map = {name: defaults_of(name, defaults) for name in COMMANDS}
        typed = [*ctx._protected_args, *ctx.args]
        try:
            return super().invoke(ctx)
        except typer.BadParameter as error:
            # An option that the user did not type came from a default, so the error must name the default.
            param = error.param
            setting = "" if param is None else str(param.name).replace("_", "-")
            from_default: list[Default] = [d for d in defaults if d.setting == setting]
            if not from_default or param is None or any(name in typed for name in param.opts):
                raise
            message = f"{error.message.rstrip('.')}; this default stands in {from_default[-1].source}."
            raise typer.BadParameter(message, ctx=error.ctx, param=param) from error


app = typer.Typer(
    name="dior-rt",
    cls=Commands,
    help="Relight a photograph from light drawn on it.",
    epilog="dior-rt COMMAND --help explains a command, with examples.",
    **STYLE,
)


@app.callback(invoke_without_command=True)
def dior_rt(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Say the version and stop.")] = False,
) -> None:
    """Relight a photograph from light drawn on it."""
    if version:
        typer.echo(__version__)
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


class TrainGroup(TyperGroup):
    """The commands of dior_rt.training.cli, which is imported when they are first requested."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands."""
        return _training().list_commands(ctx)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, or None."""
        return _training().get_command(ctx, cmd_name)

    def invoke(self, ctx: Any) -> Any:
        """Run a command."""
        with needs_extra("train"):
            return super().invoke(ctx)


@cache
def _training() -> TyperGroup:
    from dior_rt.training.cli import app as training

    group = typer.main.get_command(training)
    assert isinstance(group, TyperGroup)
    return group


app.add_typer(
    typer.Typer(cls=TrainGroup),
    name="train",
    help="Render scenes, train models, evaluate them.",
)
