"""The export: a diffusers folder and LoRAs to one bundle, part by part, held to torch and to float32."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from dior_rt.bundle import Bundle, Graph, Manifest, check_target, write_bundle
from dior_rt.errors import BundleError
from dior_rt.export.qwen.errors import check_block, compare
from dior_rt.export.qwen.graph import Precision
from dior_rt.export.qwen.lora import Lora
from dior_rt.export.qwen.modulation import tabulate, write_modulation
from dior_rt.export.qwen.parity import check_text_layer, check_vae
from dior_rt.export.qwen.sources import IN_FOLDER, MULTIPLE, Files, Sources
from dior_rt.export.qwen.text import write_text_encoder
from dior_rt.export.qwen.transformer import THETA, write_transformer
from dior_rt.export.qwen.vae import write_decoder, write_encoder
from dior_rt.export.qwen.weights import Checkpoint
from dior_rt.families.qwen.layers import Layers
from dior_rt.families.qwen.prompt import PromptEncoder
from dior_rt.families.qwen.settings import FILE, LUMI_PEAK, MODULATION, PROMPTS, QwenSettings, TextSettings
from dior_rt.families.qwen.template import Prompts
from dior_rt.flow.sampler import Array
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule
from dior_rt.records import unparse

AREA: Final = 1024**2
VISION_AREA: Final = 384**2
BYTES: Final = {"fp32": 4.0, "fp16": 2.0, "int8": 1.0, "int4": 0.625}  # a weight
LIGHTNING_SHIFT: Final = 3.0  # few-step LoRAs are trained with mu = ln 3, whatever the size

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Recipe:
    """What to make of a model.

    precision: of the transformer's blocks and of the text encoder's layers. steps, guidance: what the bundle
    does unless told otherwise. schedule: None takes the model's.

    free_steps: keep the weights that compute modulation, a third of the transformer, so that any number of
    steps can be run; without them the bundle is for `steps` alone. prompt_cache: store the prompts'
    embeddings, computed without the pictures, and leave the text encoder out; for LoRAs trained so.

    area, vision_area: pixels of the pictures that the bundle paints, and that its prompts' encoder sees.
    probe_area: of the picture by which the cost of a precision is measured.
    """

    name: str = "Qwen-Image-Edit"
    licence: str = "Apache-2.0"
    precision: Precision = "fp32"
    steps: int = 40
    guidance: float = 4.0
    schedule: ShiftSchedule | DynamicShiftSchedule | None = None
    free_steps: bool = False
    prompt_cache: bool = False
    prompts: Prompts = field(default_factory=Prompts)
    area: int = AREA
    vision_area: int = VISION_AREA
    probe_area: int = 256**2

    def few_steps(self, steps: int) -> Recipe:
        """The same for a few-step LoRA: its schedule, no guidance."""
        return replace(self, steps=steps, guidance=1.0, schedule=ShiftSchedule(LIGHTNING_SHIFT))


def export_qwen(
    folder: Path,
    out: Path,
    recipe: Recipe,
    *,
    loras: Sequence[Lora] = (),
    files: Files = IN_FOLDER,
    overwrite: bool = False,
    progress: Progress = lambda part: None,
) -> Bundle:
    """Write the bundle of a diffusers folder at `out`.

    files: of weights in place of the folder's. progress: told of each part when it is written.
    Raises InputError for what cannot be exported, ExportError where a graph computes something else than
    torch, and BundleError where nothing can be written. Nothing is left at `out` then.
    """
    check_target(out, overwrite)
    sources = Sources(folder, loras, files)
    schedule = recipe.schedule or sources.schedule()
    _check_room(sources, recipe, out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
            draft = _Draft(Path(scratch) / "draft", sources, recipe, schedule, progress)
            parity = {**draft.parity, "one_step": 0.0, "all_steps": 0.0}
            if recipe.precision != "fp32":
                exact = replace(recipe, precision="fp32")
                reference = _Draft(Path(scratch) / "fp32", sources, exact, schedule, progress)
                parity |= compare(draft.bundle, reference.bundle, recipe.probe_area)
            manifest = replace(draft.bundle.manifest, parity=parity)
            return write_bundle(out, manifest, draft.files, overwrite=overwrite)
    except OSError as error:
        raise BundleError(f"Cannot write the bundle {out}: {error}.") from error


class _Draft:
    """The files of one bundle in the making, in a folder of their own."""

    def __init__(
        self,
        folder: Path,
        sources: Sources,
        recipe: Recipe,
        schedule: ShiftSchedule | DynamicShiftSchedule,
        progress: Progress,
    ) -> None:
        """Write everything; see `export_qwen`. parity: the errors of the parts against torch's."""
        self.folder, self.sources, self.recipe, self.schedule = folder, sources, recipe, schedule
        self._progress = progress
        self._graphs: dict[str, Graph] = {}
        self._extra: list[str] = []
        self.parity: dict[str, float] = {}
        self._write_transformer()
        self._write_vae()
        fixed = self._write_modulation()
        settings = self._settings(fixed, self._write_text())
        text = json.dumps(unparse(settings), indent=2, allow_nan=False)
        (folder / FILE).write_text(text + "\n", encoding="utf-8")
        self._extra.append(FILE)

    @property
    def bundle(self) -> Bundle:
        """The bundle as it lies in the folder, to be run; its files' hashes are not known yet."""
        return Bundle(self.folder, self._manifest())

    @property
    def files(self) -> dict[str, Path]:
        """Relative path -> file, of all that belongs into the bundle."""
        graphs = [graph.file for graph in self._graphs.values()]
        data = [str(PurePosixPath(graph).with_suffix(".data")) for graph in graphs]
        return {
            name: self.folder / name
            for name in (*graphs, *data, *self._extra)
            if (self.folder / name).is_file()
        }

    def _write_transformer(self) -> None:
        config, weights, precision = (
            self.sources.transformer,
            self.sources.transformer_weights,
            self.recipe.precision,
        )
        for name, graph in write_transformer(self._new("transformer"), config, weights, precision):
            path = self._add("transformer", name, graph)
            if name.startswith("block"):
                self._worst("block", check_block(path, config, weights, int(name[-2:]), precision))

    def _write_vae(self) -> None:
        folder, config, weights = self._new("vae"), self.sources.vae, self.sources.vae_weights
        self._add("vae", "encoder", write_encoder(folder / "encoder.onnx", config, weights))
        self._add("vae", "decoder", write_decoder(folder / "decoder.onnx", config, weights))
        self.parity |= check_vae(folder, self.sources.vae_config, weights)

    def _write_modulation(self) -> tuple[float, ...]:
        """The graphs, or for a bundle of fixed steps their table; returns the sigmas that it is for."""
        config = self.sources.transformer
        folder = self._new("modulation")
        written = write_modulation(folder, config, self.sources.transformer_weights)
        if self.recipe.free_steps:
            for name, graph in written:
                self._add("modulation", name, graph)
            return ()
        sigmas = self._square_sigmas()
        rows = np.append(sigmas, np.float32(0)) if config.zero_cond_t else sigmas
        tabulate(self.folder / MODULATION, rows, folder, written, config)
        shutil.rmtree(folder)
        self._extra.append(MODULATION)
        return tuple(sigmas.tolist())

    def _square_sigmas(self) -> Array:
        """The schedule's stops before 0; where it goes by the picture's size, those of a square."""
        if isinstance(self.schedule, ShiftSchedule):
            return self.schedule.sigmas(self.recipe.steps)[:-1]
        side = self.sources.vae.factor * self.sources.transformer.patch_size
        return self.schedule.sigmas(self.recipe.steps, tokens=round(self.recipe.area / side**2))[:-1]

    def _write_text(self) -> TextSettings | None:
        """The text encoder and the words of the prompts; or, as a cache, what it makes of them."""
        sources, cache = self.sources, self.recipe.prompt_cache
        said = self.recipe.prompts.each()
        ids = {name: sources.word_ids(words, 0 if cache else shown) for name, (words, shown) in said.items()}
        settings = sources.text_settings(ids, self.recipe.vision_area)
        known = sorted({word for prompt in ids.values() for word in prompt} - {settings.picture_id})
        rows = sources.text_weights.rows("model.embed_tokens.weight", known)
        precision: Precision = "fp32" if cache else self.recipe.precision
        self._extra.append(PROMPTS)
        others = dict(self._graphs)
        for name, graph in write_text_encoder(
            self._new("text"), sources.text, sources.text_weights, precision
        ):
            path = self._add("text", name, graph)
            error = check_text_layer(path, sources.text, sources.text_weights, name, precision)
            if error is not None:
                self._worst(name.rpartition(".")[0].replace(".", "_"), error)
        if not cache:
            np.savez(self.folder / PROMPTS, ids=np.array(known), rows=rows)
            return settings
        encoder = PromptEncoder(
            settings, dict(zip(known, rows, strict=True)), Layers(self.bundle, "text.norm", "cpu", memory=0)
        )
        embeddings: Any = {name: encoder.encode(name, ()) for name in ids}
        np.savez(self.folder / PROMPTS, **embeddings)
        self._graphs = others
        shutil.rmtree(self.folder / "text")
        return None

    def _settings(self, fixed: tuple[float, ...], text: TextSettings | None) -> QwenSettings:
        config = self.sources.transformer
        return QwenSettings(
            area=self.recipe.area,
            multiple=MULTIPLE,
            factor=self.sources.vae.factor,
            patch=config.patch_size,
            layers=config.num_layers,
            axes=config.axes_dims_rope,
            theta=THETA,
            reference_at_zero=config.zero_cond_t,
            fixed_sigmas=fixed,
            lumi_peak=LUMI_PEAK,
            text=text,
        )

    def _manifest(self) -> Manifest:
        recipe = self.recipe
        return Manifest(
            family="qwen",
            name=recipe.name,
            licence=recipe.licence,
            precision=recipe.precision,
            files={},
            graphs=self._graphs,
            schedule=self.schedule,
            steps=recipe.steps,
            guidance=recipe.guidance,
            colour="srgb",
            grid=None,
            noise_scale=1.0,
            parity={},
            settings={},
        )

    def _worst(self, figure: str, error: float) -> None:
        self.parity[figure] = max(error, self.parity.get(figure, 0.0))

    def _new(self, name: str) -> Path:
        folder = self.folder / name
        folder.mkdir(parents=True)
        return folder

    def _add(self, part: str, name: str, graph: Graph) -> Path:
        """Book a graph that was written into the folder of a part."""
        name = name if part == "text" else f"{part}.{name}"
        file = f"{part}/{graph.file}"
        self._graphs[name] = replace(graph, file=file)
        self._progress(file)
        return self.folder / file


def _check_room(sources: Sources, recipe: Recipe, out: Path) -> None:
    """BundleError where the disk is too small for what will be written."""
    needed = _bytes(sources, recipe, recipe.precision)
    if recipe.precision != "fp32":
        needed += _bytes(sources, recipe, "fp32")
    if recipe.prompt_cache:
        needed += _text_bytes(sources, "fp32")  # for a while
    parent = next(folder for folder in out.resolve().parents if folder.exists())
    free = shutil.disk_usage(parent).free
    if free < needed:
        raise BundleError(
            f"Too little room at {parent}: the export writes {needed / 1e9:.1f} GB, "
            f"and {free / 1e9:.1f} GB are free."
        )


def _bytes(sources: Sources, recipe: Recipe, precision: Precision) -> float:
    """About what a bundle takes; modulation and the autoencoder are float32 in all of them."""
    base, config = sources.transformer_base, sources.transformer
    modulation = sum(math.prod(base.shape(name)) for name in base.names if "_mod.1." in name)
    table = (recipe.steps + 1) * (12 * config.num_layers + 2) * config.width
    total = BYTES[precision] * (_count(base) - modulation) + 4 * _count(sources.vae_weights)
    total += 4 * (modulation if recipe.free_steps else table)
    return total if recipe.prompt_cache else total + _text_bytes(sources, precision)


def _text_bytes(sources: Sources, precision: Precision) -> float:
    return BYTES[precision] * _count(sources.text_weights, ("model.layers.", "visual."))


def _count(weights: Checkpoint, starts: tuple[str, ...] = ("",)) -> int:
    """The numbers in the tensors whose names start so."""
    return sum(math.prod(weights.shape(name)) for name in weights.names if name.startswith(starts))
