"""Export a diffusers folder and LoRAs to a bundle, and compare each part with torch and float32."""

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
from dior_rt.families.qwen.settings import FILE, MODULATION, PROMPTS, QwenSettings, TextSettings
from dior_rt.families.qwen.template import Prompts
from dior_rt.flow.sampler import Array
from dior_rt.flow.schedule import Schedule, ShiftSchedule
from dior_rt.light import LUMI_PEAK
from dior_rt.records import unparse

AREA: Final = 1024**2
VISION_AREA: Final = 384**2
BYTES: Final = {"fp32": 4.0, "fp16": 2.0, "int8": 1.0, "int4": 0.625}  # a weight
LIGHTNING_SHIFT: Final = 3.0  # few-step LoRAs are trained with mu = ln 3 at every size

Progress = Callable[[str], None]


@dataclass(frozen=True)
class QwenExportConfig:
    """How to export a model."""

    name: str = "Qwen-Image-Edit"
    licence: str = "Apache-2.0"
    #: Precision of the transformer's blocks and of the text encoder's layers.
    precision: Precision = "fp32"
    #: Default number of steps.
    steps: int = 40
    #: Default guidance.
    guidance: float = 4.0
    #: Schedule; None takes the model's.
    schedule: Schedule | None = None
    #: Keep the weights that compute modulation, a third of the transformer, so that any number of steps can
    #: be run; without them the bundle is for `steps` alone.
    free_steps: bool = False
    #: Store the prompts' embeddings, computed without the pictures, and leave the text encoder out; for LoRAs
    #: that were trained this way.
    prompt_cache: bool = False
    prompts: Prompts = field(default_factory=Prompts)
    #: Pixels of the pictures that the bundle paints.
    area: int = AREA
    #: Pixels of the pictures that the prompts' encoder sees.
    vision_area: int = VISION_AREA
    #: Pixels of the picture on which the error of a precision is measured.
    probe_area: int = 256**2

    def few_steps(self, steps: int) -> QwenExportConfig:
        """Return the config for a few-step LoRA: its schedule, no guidance."""
        return replace(self, steps=steps, guidance=1.0, schedule=ShiftSchedule(LIGHTNING_SHIFT))


def export_qwen(
    folder: Path,
    out: Path,
    config: QwenExportConfig,
    *,
    loras: Sequence[Lora] = (),
    files: Files = IN_FOLDER,
    overwrite: bool = False,
    progress: Progress = lambda part: None,
) -> Bundle:
    """Write the bundle of a diffusers folder at `out`.

    files: weights to use instead of the folder's. progress: called with each part when it is written.
    Raises InputError for a model that cannot be exported, ExportError if a graph differs from torch, and
    BundleError if nothing can be written. Then nothing is left at `out`.
    """
    check_target(out, overwrite)
    sources = Sources(folder, loras, files)
    schedule = config.schedule or sources.schedule()
    _check_room(sources, config, out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as scratch:
            draft = _write_draft(Path(scratch) / "draft", sources, config, schedule, progress)
            bundle = draft.bundle(config, schedule)
            parity = {**draft.parity, "one_step": 0.0, "all_steps": 0.0}
            if config.precision != "fp32":
                exact = replace(config, precision="fp32")
                reference = _write_draft(Path(scratch) / "fp32", sources, exact, schedule, progress)
                parity |= compare(bundle, reference.bundle(exact, schedule), config.probe_area)
            manifest = replace(bundle.manifest, parity=parity)
            return write_bundle(out, manifest, draft.files(), overwrite=overwrite)
    except OSError as error:
        raise BundleError(f"Cannot write the bundle {out}: {error}.") from error


@dataclass
class _Draft:
    """A bundle under construction: its folder, its files and their errors."""

    folder: Path
    progress: Progress
    #: Graphs by name, their files relative to the folder.
    graphs: dict[str, Graph] = field(default_factory=dict)
    #: Files other than graphs.
    data: list[str] = field(default_factory=list)
    #: The largest errors of the parts against torch, by part.
    parity: dict[str, float] = field(default_factory=dict)

    def part(self, name: str) -> Path:
        """Return a new folder for a part of the model."""
        folder = self.folder / name
        folder.mkdir(parents=True)
        return folder

    def add(self, part: str, name: str, graph: Graph) -> Path:
        """Record a graph that was written into the folder of a part, and return its file."""
        file = f"{part}/{graph.file}"
        self.graphs[name if part == "text" else f"{part}.{name}"] = replace(graph, file=file)
        self.progress(file)
        return self.folder / file

    def add_error(self, figure: str, error: float) -> None:
        """Record an error, if it is the largest of its figure."""
        self.parity[figure] = max(error, self.parity.get(figure, 0.0))

    def files(self) -> dict[str, Path]:
        """Return relative path -> file, of everything that belongs to the bundle."""
        graphs = [graph.file for graph in self.graphs.values()]
        weights = [str(PurePosixPath(graph).with_suffix(".data")) for graph in graphs]
        names = (*graphs, *weights, *self.data)
        return {name: self.folder / name for name in names if (self.folder / name).is_file()}

    def bundle(self, config: QwenExportConfig, schedule: Schedule) -> Bundle:
        """Return the bundle in the folder, ready to run, but without the hashes of its files."""
        manifest = Manifest(
            family="qwen",
            name=config.name,
            licence=config.licence,
            precision=config.precision,
            files={},
            graphs=self.graphs,
            schedule=schedule,
            steps=config.steps,
            guidance=config.guidance,
            grid=None,
            noise_scale=1.0,
            parity={},
        )
        return Bundle(self.folder, manifest)


def _write_draft(
    folder: Path, sources: Sources, config: QwenExportConfig, schedule: Schedule, progress: Progress
) -> _Draft:
    """Write all files of a bundle into a folder, and compare each part with torch. See `export_qwen`."""
    draft = _Draft(folder, progress)
    _write_transformer(draft, sources, config.precision)
    _write_vae(draft, sources)
    sigmas = _write_modulation(draft, sources, config, schedule)
    text = _write_text(draft, sources, config, schedule)
    settings = _settings(sources, config, sigmas, text)
    document = json.dumps(unparse(settings), indent=2, allow_nan=False)
    (folder / FILE).write_text(document + "\n", encoding="utf-8")
    draft.data.append(FILE)
    return draft


def _write_transformer(draft: _Draft, sources: Sources, precision: Precision) -> None:
    """Write a graph for each block, one before them and one after them."""
    config, weights = sources.transformer, sources.transformer_weights
    for name, graph in write_transformer(draft.part("transformer"), config, weights, precision):
        path = draft.add("transformer", name, graph)
        if name.startswith("block"):
            draft.add_error("block", check_block(path, config, weights, int(name[-2:]), precision))


def _write_vae(draft: _Draft, sources: Sources) -> None:
    """Write the autoencoder's two graphs."""
    folder, config, weights = draft.part("vae"), sources.vae, sources.vae_weights
    draft.add("vae", "encoder", write_encoder(folder / "encoder.onnx", config, weights))
    draft.add("vae", "decoder", write_decoder(folder / "decoder.onnx", config, weights))
    draft.parity |= check_vae(folder, sources.vae_config, weights)


def _write_modulation(
    draft: _Draft, sources: Sources, config: QwenExportConfig, schedule: Schedule
) -> tuple[float, ...]:
    """Write the graphs of the modulation; for a fixed number of steps, write their table instead.

    Returns the sigmas of the table, none for graphs.
    """
    transformer = sources.transformer
    folder = draft.part("modulation")
    written = write_modulation(folder, transformer, sources.transformer_weights)
    if config.free_steps:
        for name, graph in written:
            draft.add("modulation", name, graph)
        return ()
    sigmas = _square_sigmas(sources, config, schedule)
    rows = np.append(sigmas, np.float32(0)) if transformer.zero_cond_t else sigmas
    tabulate(draft.folder / MODULATION, rows, folder, written, transformer)
    shutil.rmtree(folder)
    draft.data.append(MODULATION)
    return tuple(sigmas.tolist())


def _square_sigmas(sources: Sources, config: QwenExportConfig, schedule: Schedule) -> Array:
    """Return the schedule's sigmas before 0; for a schedule that depends on the size, those of a square."""
    if isinstance(schedule, ShiftSchedule):
        return schedule.sigmas(config.steps)[:-1]
    side = sources.vae.factor * sources.transformer.patch_size
    return schedule.sigmas(config.steps, tokens=round(config.area / side**2))[:-1]


def _write_text(
    draft: _Draft, sources: Sources, config: QwenExportConfig, schedule: Schedule
) -> TextSettings | None:
    """Write the text encoder and the words of the prompts; or, as a cache, the prompts' embeddings alone.

    Returns the text encoder's settings, or None for a cache.
    """
    cache = config.prompt_cache
    ids = {
        name: sources.word_ids(words, 0 if cache else pictures)
        for name, (words, pictures) in config.prompts.each().items()
    }
    settings = sources.text_settings(ids, config.vision_area)
    words = sorted({word for prompt in ids.values() for word in prompt} - {settings.picture_id})
    rows = sources.text_weights.rows("model.embed_tokens.weight", words)
    precision: Precision = "fp32" if cache else config.precision
    draft.data.append(PROMPTS)
    other_graphs = dict(draft.graphs)
    for name, graph in write_text_encoder(draft.part("text"), sources.text, sources.text_weights, precision):
        path = draft.add("text", name, graph)
        error = check_text_layer(path, sources.text, sources.text_weights, name, precision)
        if error is not None:
            draft.add_error(name.rpartition(".")[0].replace(".", "_"), error)
    if not cache:
        np.savez(draft.folder / PROMPTS, ids=np.array(words), rows=rows)
        return settings
    layers = Layers(draft.bundle(config, schedule), "text.norm", "cpu", memory=0)
    encoder = PromptEncoder(settings, dict(zip(words, rows, strict=True)), layers)
    embeddings: Any = {name: encoder.encode(name, ()) for name in ids}
    np.savez(draft.folder / PROMPTS, **embeddings)
    draft.graphs = other_graphs
    shutil.rmtree(draft.folder / "text")
    return None


def _settings(
    sources: Sources, config: QwenExportConfig, sigmas: tuple[float, ...], text: TextSettings | None
) -> QwenSettings:
    transformer = sources.transformer
    return QwenSettings(
        area=config.area,
        multiple=MULTIPLE,
        factor=sources.vae.factor,
        patch=transformer.patch_size,
        layers=transformer.num_layers,
        axes=transformer.axes_dims_rope,
        theta=THETA,
        reference_at_zero=transformer.zero_cond_t,
        fixed_sigmas=sigmas,
        lumi_peak=LUMI_PEAK,
        text=text,
    )


def _check_room(sources: Sources, config: QwenExportConfig, out: Path) -> None:
    """Raise BundleError if the disk has too little room for the export."""
    needed = _bytes(sources, config, config.precision)
    if config.precision != "fp32":
        needed += _bytes(sources, config, "fp32")
    if config.prompt_cache:
        needed += _text_bytes(sources, "fp32")  # temporarily
    parent = next(folder for folder in out.resolve().parents if folder.exists())
    free = shutil.disk_usage(parent).free
    if free < needed:
        raise BundleError(
            f"Too little room at {parent}: the export writes {needed / 1e9:.1f} GB, "
            f"and {free / 1e9:.1f} GB are free."
        )


def _bytes(sources: Sources, config: QwenExportConfig, precision: Precision) -> float:
    """Return the approximate size of a bundle. Modulation and the autoencoder are always float32."""
    base, transformer = sources.transformer_base, sources.transformer
    modulation = sum(math.prod(base.shape(name)) for name in base.names if "_mod.1." in name)
    table = (config.steps + 1) * (12 * transformer.num_layers + 2) * transformer.width
    total = BYTES[precision] * (_count(base) - modulation) + 4 * _count(sources.vae_weights)
    total += 4 * (modulation if config.free_steps else table)
    return total if config.prompt_cache else total + _text_bytes(sources, precision)


def _text_bytes(sources: Sources, precision: Precision) -> float:
    return BYTES[precision] * _count(sources.text_weights, ("model.layers.", "visual."))


def _count(weights: Checkpoint, starts: tuple[str, ...] = ("",)) -> int:
    """Return how many numbers the tensors with these prefixes hold."""
    return sum(math.prod(weights.shape(name)) for name in weights.names if name.startswith(starts))
