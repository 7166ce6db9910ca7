"""The commands that show the available devices and the content of a bundle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from dior_rt.cli import options
from dior_rt.cli.text import say, table


def devices(
    bundle: options.Bundle = None, as_json: options.Json = False, debug: options.Debug = False
) -> None:
    """List what can run the network and the pixel kernels.

    Each device is tested: the network's against the model's own answer, the pixel kernels' against NumPy. The
    last line of each kind says what auto would choose and why.

    \b
      dior-rt devices
      dior-rt devices --json
    """
    from dior_rt.bundle import default_bundle, read_bundle
    from dior_rt.devices import survey_network, survey_ops
    from dior_rt.records import unparse

    surveys = {
        "network": survey_network(read_bundle(bundle or default_bundle())),
        "ops": survey_ops(),
    }
    if as_json:
        say(json.dumps({kind: unparse(survey) for kind, survey in surveys.items()}, indent=2))
        return
    for (kind, survey), option in zip(surveys.items(), ("--device", "--ops"), strict=True):
        say(f"{kind} ({option})")
        rows: list[tuple[str, object]] = [
            (f"  {device.name}", f"{device.description}: {device.problem or 'passes its test'}")
            for device in survey.devices
        ]
        table([*rows, ("  auto", f"{survey.auto.name}: {survey.auto.reason}")])


def info(
    bundle: Annotated[
        Path | None, typer.Argument(metavar="BUNDLE", help="[default: the model that ships with dior-rt]")
    ] = None,
    as_json: options.Json = False,
    debug: options.Debug = False,
) -> None:
    """Check a bundle's files, say what is in it, and which defaults of your own are in force.

    Defaults stand in the file that `config` names, such as preset = "fast", or below a command's name, such
    as [batch]. Environment variables such as DIOR_PRESET go over them.

    \b
      dior-rt info
      dior-rt info my-bundle --json
    """
    from dior_rt.bundle import default_bundle, read_bundle
    from dior_rt.cli.defaults import config_path, read_defaults, unknown_variables
    from dior_rt.records import unparse

    found = read_bundle(bundle or default_bundle())
    manifest = found.manifest
    config, defaults = config_path(), read_defaults()
    if as_json:
        personal = {"config": str(config), "defaults": [unparse(default) for default in defaults]}
        say(json.dumps({"folder": str(found.folder), **unparse(manifest), **personal}, indent=2))
        return
    megabytes = sum((found.folder / file).stat().st_size for file in manifest.files) / 1e6
    rows = {
        "name": manifest.name,
        "folder": found.folder,
        "family": manifest.family,
        "licence": manifest.licence,
        "weights": f"{manifest.precision}, {megabytes:.1f} MB in {len(manifest.files)} files, all unaltered",
        "steps": manifest.steps,
        "guidance": f"{manifest.guidance:g}",
        "graphs": ", ".join(sorted(manifest.graphs)),
        **{f"parity {name}": f"{value:.4g}" for name, value in manifest.parity.items()},
    }
    table(list(rows.items()))
    say("")
    here: list[tuple[str, object]] = [("config", f"{config}{'' if config.exists() else ' (not there)'}")]
    for default in defaults:
        name = f"{default.command} {default.setting}" if default.command else default.setting
        value = default.value if isinstance(default.value, str) else " ".join(default.value)
        here.append((name, f"{value} (from {default.source})"))
    here += [(name, "no setting has this variable") for name in unknown_variables()]
    table(here)
