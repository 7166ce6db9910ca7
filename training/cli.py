"""`dior-rt train ...`: render scenes, train, add a LoRA, evaluate."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from dior_rt.errors import InputError
from dior_rt.extras import needs_extra
from dior_rt.training.blender.command import app as blender
from dior_rt.training.lumen.command import app as lumen

app = typer.Typer(no_args_is_help=True, help="Render scenes and train the network (needs dior-rt[train]).")
app.add_typer(blender, name="blender")
app.add_typer(lumen, name="lumen")


Precision = Annotated[Literal["no", "bf16"], typer.Option(help="bf16 where the processor or GPU has it.")]
Side = Annotated[int, typer.Option(min=32, help="Qwen: pixels a side of a square picture; others as many.")]


@app.callback()
def _group() -> None:
    """Keep this a group of commands, even with a single command. Typer needs a callback for that."""


def _shard(text: str) -> tuple[int, int]:
    index, _, count = text.partition("/")
    if not (index.isdecimal() and count.isdecimal() and int(index) < int(count)):
        raise typer.BadParameter("write it as i/n with 0 <= i < n, for example 0/2")
    return int(index), int(count)


@app.command()
def render(
    out: Annotated[Path, typer.Option(help="Folder for the renders; what is there already is kept.")],
    scenes: Annotated[int, typer.Option(min=1, help="How many scenes, two views each.")] = 750,
    seed: Annotated[int, typer.Option(min=0, max=900, help="Sets of different seeds share no scene.")] = 0,
    shard: Annotated[str, typer.Option(help="i/n: this process's share; run one process a core.")] = "0/1",
    domain: Annotated[
        Literal["plain", "world"],
        typer.Option(help="world: greater variety, environment light, less noise."),
    ] = "plain",
) -> None:
    """Render random scenes, every light source alone, as pictures and as Lumi maps. Resumable."""
    from dior_rt.training.data.render import render_scenes

    share = _shard(shard)
    with typer.progressbar(length=len(range(share[0], scenes, share[1])), label="scenes") as bar:
        render_scenes(out, scenes, seed, share, lambda done, total: bar.update(1), domain)


@app.command()
def fit(
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint; a run that stopped goes on from it.")],
    steps: Annotated[int, typer.Option(min=1)] = 4000,
    batch: Annotated[int, typer.Option(min=1)] = 32,
    rate: Annotated[float, typer.Option(min=0, help="Peak learning rate.")] = 8e-4,
    width: Annotated[int, typer.Option(min=8, help="Of a token; a multiple of 4 times the heads.")] = 256,
    depth: Annotated[int, typer.Option(min=1)] = 8,
    heads: Annotated[int, typer.Option(min=1)] = 8,
    precision: Precision = "no",
    compiled: Annotated[bool, typer.Option("--compile", help="Minutes at first, then faster steps.")] = False,
    drawn: Annotated[float, typer.Option(min=0, help="How much more errors count under strokes.")] = 4.0,
    edges: Annotated[float, typer.Option(min=0, help="Of the loss on differences between cells.")] = 0.5,
    response: Annotated[
        float, typer.Option(min=0, help="Of the loss on twice the value being twice the light.")
    ] = 0.5,
    start: Annotated[
        Path | None, typer.Option(metavar="FILE", help="model.safetensors to go on from, with its sizes.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Train the network on renders. `accelerate launch -m dior_rt train fit ...` uses several GPUs."""
    from dior_rt.training.fit import Plan
    from dior_rt.training.fit import fit as run
    from dior_rt.training.network import Config

    plan = Plan(
        steps,
        batch,
        rate,
        drawn=drawn,
        edges=edges,
        response=response,
        seed=seed,
        precision=precision,
        compiled=compiled,
    )
    with _Bar(steps) as bar:
        run(renders, out, start or Config(width, depth, heads), plan, bar.show)


@app.command()
def lora(
    base: Annotated[Path, typer.Argument(help="model.safetensors of a trained network.")],
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder of the checkpoint: the base's weights and the LoRA.")],
    rank: Annotated[int, typer.Option(min=1)] = 32,
    steps: Annotated[int, typer.Option(min=1)] = 500,
    batch: Annotated[int, typer.Option(min=1)] = 32,
    rate: Annotated[float, typer.Option(min=0)] = 4e-4,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 1,
) -> None:
    """Train a LoRA on top of a network; `dior-rt export` merges it."""
    from dior_rt.training.fit import Plan, fit_lora

    plan = Plan(steps, batch, rate, warmup=50, seed=seed, precision=precision)
    with _Bar(steps) as bar:
        fit_lora(base, renders, out, rank, plan, bar.show)


@app.command()
def qwen_lora(
    model: Annotated[Path, typer.Argument(help="Qwen-Image-Edit as diffusers has it.")],
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder of the LoRA; a run that stopped goes on from it.")],
    rank: Annotated[int, typer.Option(min=1)] = 64,
    steps: Annotated[int, typer.Option(min=1)] = 15000,
    batch: Annotated[int, typer.Option(min=1)] = 8,
    rate: Annotated[float, typer.Option(min=0)] = 1e-4,
    side: Side = 512,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 1,
) -> None:
    """Train a LoRA on Qwen-Image-Edit with the same triplets and loss (needs dior-rt[qwen]).

    `dior-rt export MODEL --lora OUT/pytorch_lora_weights.safetensors --prompt-cache` merges it.
    """
    with needs_extra("qwen", command="train qwen-lora"):
        from dior_rt.training.fit import Plan
        from dior_rt.training.qwen import fit_qwen_lora

        plan = Plan(steps, batch, rate, seed=seed, precision=precision)
        with _Bar(steps) as bar:
            fit_qwen_lora(model, renders, out, rank, plan, area=side**2, progress=bar.show)


@app.command()
def photos(
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder for the photos: OUT/<view>/<k>.png.")],
    scenes: Annotated[int | None, typer.Option(min=1, help="How many; all if not given.")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Take photos of rendered scenes under several lights, by random cameras: pairs for `stage2`."""
    from dior_rt.training.data.photos import take_photos

    with typer.progressbar(length=scenes or len(list(renders.glob("*-1.npz"))), label="scenes") as bar:
        take_photos(renders, out, None, scenes, seed, lambda done, total: bar.update(1))


@app.command()
def stage2(
    base: Annotated[
        Path,
        typer.Argument(
            help="model.safetensors of a trained network, or Qwen-Image-Edit as diffusers has it."
        ),
    ],
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    pairs: Annotated[
        Path, typer.Argument(help="Folder of scenes: PAIRS/<scene>/<photo>, photos of one view.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the LoRA; a run that stopped goes on from it.")],
    photos: Annotated[
        str, typer.Option(metavar="PATTERN", help="Which files of a scene are its photos.")
    ] = "*",
    rendered_weight: Annotated[
        float, typer.Option(min=0, help="Of the loss on renders beside real pairs.")
    ] = 1.0,
    estimate_steps: Annotated[int, typer.Option(min=1, help="Of the flow, to the light of a target.")] = 1,
    rank: Annotated[int, typer.Option(min=1)] = 64,
    steps: Annotated[int, typer.Option(min=1)] = 500,
    batch: Annotated[int, typer.Option(min=2, help="Even; half of it is real pairs.")] = 32,
    rate: Annotated[float, typer.Option(min=0)] = 5e-5,
    start: Annotated[Path | None, typer.Option(metavar="FILE", help="Qwen: the LoRA of stage 1.")] = None,
    side: Side = 512,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 2,
) -> None:
    """Train a LoRA on real photos and renders at once.

    A real pair is two photos of one view under different light. The model estimates the light of one, and
    has to relight the other with strokes cut from that estimate.
    """
    from dior_rt.training.backbone import Backbone, MiniLora
    from dior_rt.training.fit import Plan
    from dior_rt.training.stage2 import Mixture, fit_stage2, load_scenes

    plan = Plan(steps, batch, rate, warmup=50, seed=seed, precision=precision)
    is_qwen = (base / "model_index.json").is_file()
    if start and not is_qwen:
        raise InputError(f"{base} is no Qwen-Image-Edit, and --start is for that.")

    def make() -> Backbone:
        if not is_qwen:
            return MiniLora(base, rank, out)
        with needs_extra("qwen", command="train stage2"):
            from dior_rt.training.qwen import QwenLora, dtype_of

            return QwenLora(base, out, rank, None, side**2, start, dtype_of(plan))

    with _Bar(steps) as bar:
        mixture = Mixture(rendered_weight, estimate_steps)
        fit_stage2(make, renders, load_scenes(pairs, photos), out, plan, mixture, bar.show)


@app.command()
def synthbench(
    out: Annotated[Path, typer.Option(help="Folder of the benchmark; what is there already is kept.")],
    pairs: Annotated[int, typer.Option(min=1, max=1000)] = 600,
    seed: Annotated[int, typer.Option(min=0, max=90, help="Of other seeds, other scenes.")] = 0,
    resolution: Annotated[int, typer.Option(min=16, help="Pixels a side.")] = 128,
    samples: Annotated[int, typer.Option(min=1, help="Rays a pixel and source, before denoising.")] = 8,
    shard: Annotated[str, typer.Option(help="i/n: this process's share; run one process a core.")] = "0/1",
) -> None:
    """Render SynthBench: pairs of very different light, with true maps, for `eval`. Resumable."""
    from dior_rt.training.evaluation.synthbench import Recipe, render_synthbench

    share = _shard(shard)
    with typer.progressbar(length=len(range(share[0], pairs, share[1])), label="pairs") as bar:
        render_synthbench(
            out, Recipe(pairs, seed, resolution, samples), share, lambda done, total: bar.update(1)
        )


@app.command()
def realbench(
    views: Annotated[Path, typer.Argument(help="Folder of rendered views of the test split.")],
    out: Annotated[Path, typer.Option(help="Folder of the benchmark; what is there already is kept.")],
    pairs: Annotated[int, typer.Option(min=1)] = 300,
    seed: Annotated[int, typer.Option(min=0, help="Different seeds draw different lights.")] = 0,
) -> None:
    """Make RealBench: pairs of held-out views with one lamp changed, added or replaced, for `eval`."""
    from dior_rt.training.evaluation.judges.realbench import Recipe, make_realbench

    with typer.progressbar(length=pairs, label="pairs") as bar:
        make_realbench(views, out, Recipe(pairs, seed), lambda done, total: bar.update(1))


@app.command()
def sheet(
    bundle: Annotated[Path, typer.Argument(help="Folder of a bundle.")],
    out: Annotated[Path, typer.Option(help="Folder for sheet.jpg and one picture for each idea.")],
    steps: Annotated[int | None, typer.Option(min=1, help="Of the flow [default: the bundle's own].")] = None,
) -> None:
    """Render the photographer's sheet: the lighting ideas of docs/sheet on real photos."""
    from dior_rt.training.evaluation.judges.sheet import make_sheet, read_ideas

    with typer.progressbar(length=len(read_ideas()), label="ideas") as bar:
        make_sheet(bundle, out, steps, progress=lambda done, total: bar.update(1))


@app.command(name="eval")
def evaluate(
    method: Annotated[Path, typer.Argument(help="Folder of a bundle, or of another method's pictures.")],
    benchmark: Annotated[
        Path,
        typer.Argument(
            help="Renders that training has not seen, or SynthBench, RealBench, MultiIllum, ReNe. "
            "With --judges: the word photos, or a folder of photos, renders or pairs."
        ),
    ],
    judges: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Judge the model in place of the benchmark: material, objects, form, identity, slope, far, "
            "added, ratio; separated by commas.",
        ),
    ] = None,
    views: Annotated[int, typer.Option(min=1, help="How many pairs of each kind at most.")] = 80,
    dabs: Annotated[int, typer.Option(min=0, help="On renders: how many views the brush visits.")] = 10,
    steps: Annotated[int | None, typer.Option(min=1, help="Of the flow [default: the bundle's own].")] = None,
    guidance: Annotated[float | None, typer.Option(min=0, help="[default: the bundle's own]")] = None,
    noise_scale: Annotated[
        float | None, typer.Option(min=0, help="Of the start [default: the bundle's own].")
    ] = None,
    reach: Annotated[
        float | None, typer.Option(help="How far from the strokes light changes, see `dior-rt relight`.")
    ] = None,
    lpips: Annotated[bool, typer.Option("--lpips", help="Also LPIPS (needs dior-rt[lpips]).")] = False,
    photos: Annotated[Path | None, typer.Option(help="Photos to look for patch borders in.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for report.json, report.md and contact.png.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="JSON instead of tables.")] = False,
) -> None:
    """Measure how well a bundle relights, beside baselines, and how it answers to the brush.

    Pictures of another method are called {task}.png; a name that is missing is told.
    """
    from dior_rt.files import make_folder
    from dior_rt.training.evaluation.judges.panel import judge, parse_judges
    from dior_rt.training.evaluation.methods import Settings
    from dior_rt.training.evaluation.report import as_json as to_json
    from dior_rt.training.evaluation.report import markdown, write_report
    from dior_rt.training.evaluation.results import Example
    from dior_rt.training.evaluation.run import Plan, evaluate

    settings = Settings(steps, guidance, noise_scale, reach)
    names = parse_judges(judges) if judges is not None else ()
    examples: list[Example] = []
    if out:
        make_folder(out)  # checked now, rather than after the work
    if names:
        evaluation = judge(method, benchmark, names, settings, views)
    else:
        evaluation, examples = evaluate(method, benchmark, settings, Plan(views, dabs, lpips, photos))
    if out:
        write_report(out, evaluation, examples)
    typer.echo(to_json(evaluation) if as_json else markdown(evaluation))


@app.command()
def maps(
    renders: Annotated[Path, typer.Argument(help="Folder of renders.")],
    out: Annotated[Path, typer.Option(help="Folder for the views; what is there already is kept.")],
    views: Annotated[int, typer.Option(min=1, help="How many, the first camera's of as many scenes.")] = 250,
    first: Annotated[int, typer.Option(min=0, help="The scene to begin with.")] = 0,
) -> None:
    """Render irradiance, shading and Phong maps of renders, in the Lumi map's place, for `ablation`."""
    from dior_rt.training.data.maps import render_maps

    with typer.progressbar(length=views, label="views") as bar:
        render_maps(renders, out, views, first, progress=lambda done, total: bar.update(1))


@app.command()
def ablation(
    maps: Annotated[Path, typer.Argument(help="Folder of `maps` to train on.")],
    held_out: Annotated[Path, typer.Argument(help="Folder of `maps` of other renders, to judge by.")],
    renders: Annotated[Path, typer.Argument(help="What MAPS was made of; its other scenes become photos.")],
    out: Annotated[Path, typer.Option(help="Folder of the networks and the report; resumable.")],
    steps: Annotated[int, typer.Option(min=1, help="Of stage 1.")] = 400,
    lora_steps: Annotated[int, typer.Option(min=1)] = 80,
    batch: Annotated[int, typer.Option(min=2, help="Even; in stage 2 half of it is real pairs.")] = 8,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Train small networks on each kind of map, and on Lumi maps without stage 2, and compare them."""
    from dataclasses import replace

    from dior_rt.training.evaluation.report import markdown, write_report
    from dior_rt.training.studies.ablation import Budget, ablate

    budget = Budget()
    stage1 = replace(budget.stage1, steps=steps, batch=batch, precision=precision, seed=seed)
    lora = replace(budget.lora, steps=lora_steps, batch=batch, precision=precision, seed=seed + 1)

    def show(training: str, step: int, loss: float) -> None:
        if step % 50 == 0:
            typer.echo(f"{training}: step {step}, loss {loss:.4f}", err=True)

    budget = replace(budget, stage1=stage1, lora=lora)
    evaluation, examples = ablate(maps, held_out, renders, out, budget, show)
    write_report(out, evaluation, examples)
    typer.echo(markdown(evaluation))


@app.command()
def recipes(
    renders: Annotated[Path, typer.Argument(help="Folder of renders to train on.")],
    held_out: Annotated[Path, typer.Argument(help="Folder of other scenes' renders, to judge by.")],
    out: Annotated[Path, typer.Option(help="Folder of the networks and the report; resumable.")],
    steps: Annotated[
        int, typer.Option(min=2, help="Of what ships; the other recipes take as many as cost the same.")
    ] = 400,
    batch: Annotated[int, typer.Option(min=1)] = 8,
    precision: Precision = "no",
    seed: Annotated[int, typer.Option(min=0)] = 0,
) -> None:
    """Train small networks by several recipes at equal cost, and compare them.

    Where the flow starts (noise, a regression, the photo, an estimate), and the network's shape. All see the
    same batches; what is trained is kept, so a study that stopped goes on.
    """
    from dataclasses import replace

    from dior_rt.training.evaluation.report import markdown, write_report
    from dior_rt.training.studies.recipes import PLAN, study, total_steps

    plan = replace(PLAN, steps=steps, batch=batch, precision=precision, seed=seed)
    with _Bar(total_steps(plan)) as bar:
        evaluation, examples = study(renders, held_out, out, plan, progress=bar.show)
    write_report(out, evaluation, examples)
    typer.echo(markdown(evaluation))


class _Bar:
    """A progress bar on a terminal. Elsewhere it prints a line every hundred steps."""

    def __init__(self, steps: int) -> None:
        self.steps, self.began = steps, time.monotonic()

    def __enter__(self) -> _Bar:
        self.bar = (
            typer.progressbar(length=self.steps, label="steps").__enter__() if sys.stderr.isatty() else None
        )
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar:
            self.bar.render_finish()

    def show(self, step: int, loss: float) -> None:
        if self.bar:
            self.bar.label = f"loss {loss:.4f}"
            self.bar.update(step - self.bar.pos)
        elif step % 100 == 0 or step == self.steps:
            typer.echo(
                f"step {step}/{self.steps}  loss {loss:.4f}  {time.monotonic() - self.began:.0f} s", err=True
            )
