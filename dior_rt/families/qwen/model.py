"""Qwen: Qwen-Image-Edit with a LoRA that relights. It paints the full picture of about 1024 x 1024 pixels.

The model sees the photo and the Lumi map of the strokes twice: through the autoencoder, as tokens beside
those being denoised, and through the vision-language model that reads the prompt. The data variable x0 of
the flow is the normalised latents of the painted picture, in tokens of 2 x 2. The painted picture is the
relit photo or its Lumi map.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from dior_rt.bundle import Bundle
from dior_rt.errors import BundleError, InputError
from dior_rt.families import Mode
from dior_rt.families.qwen.frame import Frame, fit_content, resize, shrink
from dior_rt.families.qwen.layers import Layers
from dior_rt.families.qwen.prompt import Features, PromptEncoder
from dior_rt.families.qwen.rope import joint_places, turns
from dior_rt.families.qwen.settings import MODULATION, PROMPTS, read_settings
from dior_rt.families.qwen.vae import decode_tiled, encode_tiled
from dior_rt.flow.sampler import Array, Velocity, guide
from dior_rt.flow.schedule import DynamicShiftSchedule
from dior_rt.kernels import Ops, Strokes
from dior_rt.light import decode_small, draw_lumi, pack_patches, undraw_lumi, unpack_patches

NEGATIVE: Final[dict[Mode, str]] = {"relight": "relight_negative", "estimate": "estimate_negative"}
SAME_SIGMA: Final = 1e-6
MUCH_SMALLER: Final = 1.2  # pictures closer to the model's size are not enlarged


@dataclass(frozen=True)
class Condition:
    """The inputs of the network besides x and sigma.

    raster: of the photo. frame: its place on the canvas, enlarged if it is small. references: the pictures'
    tokens (I, C). sizes: (rows, columns) of the tokens being denoised, then of each picture. features: of
    each picture, for the prompts that refer to them.
    """

    mode: Mode
    raster: tuple[int, int]
    frame: Frame
    references: Array
    sizes: tuple[tuple[int, int], ...]
    features: tuple[Features, ...]


class Qwen:
    """A qwen bundle, loaded on a device: the `Family` of `Condition`."""

    def __init__(
        self,
        bundle: Bundle,
        device: str = "auto",
        threads: int | None = None,
        memory: int | None = None,
        area: int | None = None,
    ) -> None:
        """Load the bundle.

        memory: bytes of weights that may stay loaded; None takes most of the free memory. The other weights
        are read again at each step. area: pixels of the painted picture; None takes the model's. Raises
        BundleError if the bundle is no complete qwen, and what `open_engine` raises.
        """
        if bundle.manifest.family != "qwen":
            raise BundleError(f"{bundle.folder} is no bundle of the family qwen.")
        self.settings, self._schedule = read_settings(bundle), bundle.manifest.schedule
        self.area = area or self.settings.area
        self.layers = Layers(bundle, "vae.encoder", device, threads, memory)
        self.device, self.reason = self.layers.device, self.layers.reason
        self._table = self._read_table(bundle)
        self._computed: dict[bytes, Array] = {}
        self._cached, self._prompts = self._read_prompts(bundle)

    def raster(self, height: int, width: int) -> tuple[int, int]:
        content = fit_content(self.area, height, width, self.settings.multiple)
        return content if content[0] <= height else (height, width)

    def reduce_photo(self, pixels: NDArray, raster: tuple[int, int], ops: Ops) -> tuple[Array, Array]:
        seen = shrink(pixels, raster)  # as diffusers does, because the model was trained on such pictures
        return decode_small(seen), seen

    def encode(self, photo: Array, strokes: Strokes | None, mode: Mode) -> Condition:
        raster = (photo.shape[0], photo.shape[1])
        frame = Frame.around(self._content(raster), self.settings.multiple)
        seen = resize(np.rint(photo * 255).astype(np.uint8), frame.content, Image.Resampling.LANCZOS)
        pictures = [frame.pad(seen, mirror=True)]
        if strokes is not None:
            drawn = resize(self.draw(strokes), frame.content, Image.Resampling.BILINEAR)
            pictures.append(frame.pad(drawn, mirror=False))
        features = self._prompts.look(pictures) if self._prompts else []
        side = self.settings.factor * self.settings.patch
        size = (frame.canvas[0] // side, frame.canvas[1] // side)
        tokens = np.concatenate([self.to_tokens(picture) for picture in pictures])
        return Condition(mode, raster, frame, tokens, (size,) * (1 + len(pictures)), tuple(features))

    def noise_shape(self, condition: Condition) -> tuple[int, ...]:
        rows, columns = condition.sizes[0]
        return rows * columns, condition.references.shape[1]

    def sigmas(self, steps: int, condition: Condition) -> Array:
        """See `Family.sigmas`. Raises InputError if the bundle is for another number of steps."""
        fixed = self.settings.fixed_sigmas
        if fixed:
            if steps != len(fixed):
                raise InputError(
                    f"This model was exported for {len(fixed)} steps, not {steps}; "
                    "export it with --free-steps."
                )
            return np.array([*fixed, 0], np.float32)
        if isinstance(self._schedule, DynamicShiftSchedule):
            return self._schedule.sigmas(steps, tokens=self.noise_shape(condition)[0])
        return self._schedule.sigmas(steps)

    def velocity(self, condition: Condition, sigmas: Array, guidance: float) -> Velocity:
        """See `Family.velocity`. The null branch is the negative prompt with the same pictures.

        The guided velocity is rescaled, token by token, to the norm of the conditional one.
        """
        modulation = self.modulation(sigmas[:-1])
        steps = {sigma: step for step, sigma in enumerate(sigmas[:-1].tolist())}
        texts = [] if guidance == 0 else [self._text(condition.mode, condition)]
        texts += [] if guidance == 1 else [self._text(NEGATIVE[condition.mode], condition)]

        def velocity(x: Array, sigma: float) -> Array:
            step = steps[sigma]
            rows = modulation[[step, -1]] if self.settings.reference_at_zero else modulation[[step]]
            v, *null = self.predict(x, condition, texts, rows)
            return rescaled(guide(null[0], v, guidance), v) if null else v

        return velocity

    def decode_relit(self, x0: Array, condition: Condition) -> Array:
        return self.paint(x0, condition)

    def decode_lumi(self, x0: Array, condition: Condition) -> Array:
        return self.undraw(self.paint(x0, condition))

    def predict(self, x: Array, condition: Condition, texts: Sequence[Array], rows: Array) -> list[Array]:
        """Return the velocity of x (tokens, C) under each of the texts.

        rows: the modulation (1 or 2, 12 layers + 2, D), at sigma and, for the references, at 0. Each layer
        runs for all texts before the next one, so that a layer is loaded once at most.
        """
        latents = np.concatenate([x, condition.references])
        states = []
        for text in texts:
            cos, sin = self.turns(len(text), condition.sizes)
            out = self.layers.run("transformer.embed", {"latents": latents, "text": text})
            states.append({"image": out["image_out"], "text": out["text_out"], "cos": cos, "sin": sin})
        lengths = {"lengths": np.array([len(x), len(condition.references)])} if len(rows) == 2 else {}
        for layer in range(self.settings.layers):
            engine = self.layers.engine(f"transformer.block.{layer:02}")
            image = rows[:, 12 * layer : 12 * layer + 6]
            tables = {
                "image_modulation": image if len(rows) == 2 else image[0],
                "text_modulation": rows[0, 12 * layer + 6 : 12 * layer + 12],
            }
            for state in states:
                out = engine.run({**state, **tables, **lengths})
                state["image"], state["text"] = out["image_out"], out["text_out"]
        last = rows[0, -2:]
        return [self._head(state["image"][: len(x)], last) for state in states]

    def paint(self, x0: Array, condition: Condition) -> Array:
        """Return the picture of a state (tokens, C) on the photo's raster (h, w, 3), sRGB-encoded 0..1."""
        latents = unpack_patches(x0, condition.sizes[0], self.settings.patch)
        pixels = decode_tiled(self._decode, latents, self.settings.factor)
        content = condition.frame.crop((pixels[0].transpose(1, 2, 0) + 1) / 2)
        small = resize(content, condition.raster, Image.Resampling.LANCZOS)
        return np.ascontiguousarray(small.clip(0, 1), np.float32)

    def draw(self, strokes: Strokes) -> NDArray[np.uint8]:
        """Return strokes as the picture that the model sees; unspecified light is black."""
        return draw_lumi(strokes.light, strokes.mask, self.settings.lumi_peak)

    def undraw(self, picture: Array) -> Array:
        """Return linear light >= 0 from a picture 0..1 of a Lumi map: the inverse of `draw`."""
        return undraw_lumi(picture, self.settings.lumi_peak)

    def to_tokens(self, picture: NDArray[np.uint8]) -> Array:
        """Return the tokens (I, C) of an sRGB picture (h, w, 3) whose sides are multiples of a token."""
        pixels = picture.transpose(2, 0, 1)[None].astype(np.float32) / np.float32(127.5) - 1
        return pack_patches(encode_tiled(self._encode, pixels, self.settings.factor), self.settings.patch)

    def turns(self, words: int, sizes: Sequence[tuple[int, int]]) -> tuple[Array, Array]:
        """Return the rotary positions of words and of all pictures' tokens, (T + I, head / 2)."""
        return turns(joint_places(words, sizes), self.settings.axes, self.settings.theta)

    def modulation(self, sigmas: Array) -> Array:
        """Return the rows of modulation (sigmas, 12 layers + 2, D), plus one for 0 if references need it.

        They are read from the bundle's table, or computed once per schedule.
        """
        fixed = self.settings.fixed_sigmas
        if self._table is not None:
            if len(sigmas) != len(fixed) or np.abs(sigmas - np.array(fixed)).max() > SAME_SIGMA:
                raise InputError(
                    "This model has no modulation for these sigmas; export it with --free-steps."
                )
            return self._table
        key = sigmas.tobytes()
        if key not in self._computed:
            self._computed = {key: self._compute_modulation(sigmas)}  # a picture or a series has one schedule
        return self._computed[key]

    def _compute_modulation(self, sigmas: Array) -> Array:
        if self.settings.reference_at_zero:
            sigmas = np.append(sigmas, np.float32(0))
        embedding = self.layers.run("modulation.time", {"sigma": sigmas})["embedding"]
        names = [f"modulation.block.{layer:02}" for layer in range(self.settings.layers)]
        rows = (self.layers.run(n, {"embedding": embedding})["rows"] for n in (*names, "modulation.head"))
        return np.concatenate(list(rows), axis=1)

    def _content(self, raster: tuple[int, int]) -> tuple[int, int]:
        """Return the size at which the model sees a raster: larger if it is much smaller than the model's
        pictures."""
        content = fit_content(self.area, *raster, self.settings.multiple)
        return content if content[0] > MUCH_SMALLER * raster[0] else raster

    def _head(self, image: Array, modulation: Array) -> Array:
        feeds = {"image": image, "modulation": modulation}
        return self.layers.run("transformer.head", feeds)["velocity"]

    def _encode(self, pixels: Array) -> Array:
        return self.layers.run("vae.encoder", {"pixels": pixels})["latents"]

    def _decode(self, latents: Array) -> Array:
        return self.layers.run("vae.decoder", {"latents": latents})["pixels"]

    def _text(self, prompt: str, condition: Condition) -> Array:
        """Return the embeddings (T, D) of a prompt."""
        if self._prompts is None:
            return self._cached[prompt]
        return self._prompts.encode(prompt, condition.features)

    def _read_prompts(self, bundle: Bundle) -> tuple[Mapping[str, Array], PromptEncoder | None]:
        """Read the prompts' embeddings, or the encoder that computes them."""
        with _readable(bundle, PROMPTS), np.load(bundle.folder / PROMPTS, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
            if self.settings.text is None:
                return {name: arrays[name] for pair in NEGATIVE.items() for name in pair}, None
            words = dict(zip(arrays["ids"].tolist(), arrays["rows"], strict=True))
            return {}, PromptEncoder(self.settings.text, words, self.layers)

    def _read_table(self, bundle: Bundle) -> Array | None:
        fixed = self.settings.fixed_sigmas
        if not fixed:
            return None
        with _readable(bundle, MODULATION):
            table = np.load(bundle.folder / MODULATION, mmap_mode="r", allow_pickle=False)
            rows = len(fixed) + self.settings.reference_at_zero
            if table.shape[:2] != (rows, 12 * self.settings.layers + 2):
                raise ValueError("it is for another schedule")
            return table


def rescaled(v: Array, like: Array) -> Array:
    """Return v with each token scaled to the norm of `like`. A token of norm 0 stays 0."""
    (v, _, norm), (_, largest, wanted) = _measured(v), _measured(like)
    return v / np.maximum(norm, 1) * (largest * wanted)


def _measured(v: Array) -> tuple[Array, Array, Array]:
    """Return each token divided by its largest |value|, that value, and the norm of the quotient.

    The norm is 0 or at least 1, so no square overflows or vanishes.
    """
    largest = np.abs(v).max(axis=-1, keepdims=True)
    unit = np.divide(v, largest, out=np.zeros_like(v), where=largest > 0)
    return unit, largest, np.linalg.norm(unit, axis=-1, keepdims=True)


@contextlib.contextmanager
def _readable(bundle: Bundle, name: str) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError) as error:
        raise BundleError(f"Cannot read {bundle.folder / name}: {error}.") from error
