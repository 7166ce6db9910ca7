"""The command that makes a bundle from a network that was trained here or from Qwen-Image-Edit."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from dior_rt.cli import options
from dior_rt.cli.text import table
from dior_rt.errors import InputError
from dior_rt.extras import needs_extra
from dior_rt.files import reason

if TYPE_CHECKING:
    from dior_rt.flow.schedule import ShiftSchedule

Precision = Literal["fp32", "fp16", "int8", "int4"]


def export(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FOLDER", help="A checkpoint of training, or Qwen-Image-Edit as diffusers has it."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", metavar="BUNDLE", help="The folder to make.")],
    lora: Annotated[
        list[str], typer.Option(metavar="PATH[:STRENGTH]", help="A LoRA to be merged; may be repeated.")
    ] = [],  # noqa: B006 - typer copies it
    weights: Annotated[
        Precision, typer.Option("--weights", "--precision", help="How the weights are stored.")
    ] = "fp16",
    steps: Annotated[int, typer.Option(min=1, max=1000, help="The steps that the bundle takes.")] = 40,
    guidance: Annotated[
        float | None, typer.Option(min=0, help="A checkpoint of training: its own default guidance [1].")
    ] = None,
    noise_scale: Annotated[
        float | None,
        typer.Option(min=0, help="A checkpoint of training: how strong its starting noise is [1]."),
    ] = None,
    shift: Annotated[
        float | None,
        typer.Option(help="A checkpoint of training: its schedule's; more spends more steps near noise [8]."),
    ] = None,
    few_steps: Annotated[
        int | None,
        typer.Option(
            min=1, max=1000, help="Qwen with a few-step LoRA: its steps; no guidance, its own schedule."
        ),
    ] = None,
    free_steps: Annotated[
        bool, typer.Option("--free-steps", help="Qwen: keep what other numbers of steps need, a third more.")
    ] = False,
    prompt_cache: Annotated[
        bool,
        typer.Option(
            "--prompt-cache", help="Qwen: store the prompts' embeddings, and leave their encoder out."
        ),
    ] = False,
    transformer: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Qwen: the transformer's weights in one safetensors file."),
    ] = None,
    vae: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Qwen: the autoencoder's weights, likewise.")
    ] = None,
    text_encoder: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Qwen: the text encoder's weights, likewise.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the bundle at BUNDLE.")] = False,
    debug: options.Debug = False,
) -> None:
    """Make a bundle of a trained checkpoint, or of Qwen-Image-Edit with LoRAs.

    LoRAs are merged, the network is converted to ONNX and compared with torch; where they differ, nothing is
    written. Needs pip install 'dior-rt[export]', or for Qwen 'dior-rt[qwen]'.

    \b
      dior-rt export runs/mini --lora runs/mini-lora/lora --guidance 1.25 -o bundles/mini
      dior-rt export Qwen-Image-Edit-2511 --lora dior.safetensors --weights int8 -o bundles/qwen
      dior-rt export Qwen-Image-Edit-2511 --lora dior.safetensors --lora lightning.safetensors:0.9 \\
          --few-steps 8 -o bundles/qwen-fast
    """
    if (source / "model_index.json").is_file():
        if any(option is not None for option in (guidance, noise_scale, shift)):
            raise InputError(
                "Qwen-Image-Edit has its own guidance, noise and schedule; those options are for training's."
            )
        with needs_extra("qwen", command="export"):
            from dior_rt.export.qwen.bundle import QwenExportConfig, export_qwen
            from dior_rt.export.qwen.lora import Lora
            from dior_rt.export.qwen.sources import Files

            config = QwenExportConfig(
                precision=weights, steps=steps, free_steps=free_steps, prompt_cache=prompt_cache
            )
            bundle = export_qwen(
                source,
                out,
                config.few_steps(few_steps) if few_steps else config,
                loras=[Lora(*_path_and_strength(one)) for one in lora],
                files=Files(transformer, vae, text_encoder),
                overwrite=overwrite,
                progress=_show,
            )
    elif (source / "state.json").is_file():
        if lora or few_steps or free_steps or prompt_cache or transformer or vae or text_encoder:
            raise InputError(f"{source} is a run of lumen, and takes no LoRA and no option of Qwen's.")
        if weights not in ("fp16", "fp32"):
            raise InputError(f"A run of lumen is stored as fp16 or fp32, not {weights}.")
        with needs_extra("export"):
            from dior_rt.export.lumen import LumenExportConfig, export_lumen

            settings = LumenExportConfig(
                schedule=_schedule(3.0 if shift is None else shift),
                steps=steps,
                guidance=1.0 if guidance is None else guidance,
                noise_scale=1.0 if noise_scale is None else noise_scale,
            )
            bundle = export_lumen(source, out, config=settings, weights=weights, overwrite=overwrite)
    else:
        files = transformer or vae or text_encoder
        if few_steps or free_steps or prompt_cache or files or weights == "int4":
            raise InputError(f"{source} is no Qwen-Image-Edit, and these options are for that.")
        if len(lora) > 1:
            raise InputError("A checkpoint of training takes one LoRA.")
        with needs_extra("export"):
            from dior_rt.export.mini import MiniExportConfig, export_checkpoint

            bundle = export_checkpoint(
                source,
                out,
                lora=Path(lora[0]) if lora else None,
                config=MiniExportConfig(
                    schedule=_schedule(8.0 if shift is None else shift),
                    steps=steps,
                    guidance=1.0 if guidance is None else guidance,
                    noise_scale=1.0 if noise_scale is None else noise_scale,
                ),
                weights=weights,
                overwrite=overwrite,
            )
    table([(f"parity {name}", f"{value:.4g}") for name, value in bundle.manifest.parity.items()])


def _schedule(shift: float) -> ShiftSchedule:
    from dior_rt.flow.schedule import ShiftSchedule  # --help does not need numpy

    try:
        return ShiftSchedule(shift)
    except ValueError as error:
        raise InputError(f"No schedule can be so: {reason(error)}.") from error


def _path_and_strength(text: str) -> tuple[Path, float]:
    """Return the parts of FILE or FILE:STRENGTH. A colon without a number after it is part of the name."""
    path, _, strength = text.rpartition(":")
    try:
        return (Path(path), float(strength)) if path else (Path(text), 1.0)
    except ValueError:
        return Path(text), 1.0


def _show(file: str) -> None:
    """Print each part that is written, on a terminal only: a whole model takes hours."""
    if sys.stderr.isatty():
        typer.echo(f"written: {file}", err=True)
