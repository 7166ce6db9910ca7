"""A LoRA on Qwen-Image-Edit, trained with the same triplets, losses, loop and stages as mini.

It is a `Backbone`: its data variable is the latents of the picture to be painted, photo and light are the
latents of the two references, and the network is diffusers' transformer with peft's LoRA. The prompts are
embedded once, without pictures, so the LoRA belongs in a bundle with a prompt cache.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import torch
from diffusers import AutoencoderKLQwenImage, QwenImageEditPlusPipeline, QwenImageTransformer2DModel
from diffusers.training_utils import cast_training_params
from peft import LoraConfig, get_peft_model_state_dict, set_peft_model_state_dict
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional as F
from transformers import Qwen2_5_VLForConditionalGeneration, Qwen2Tokenizer

from dior_rt.errors import InputError
from dior_rt.families.mini import MODES
from dior_rt.families.qwen.frame import fit_area
from dior_rt.families.qwen.template import SKIP, TEMPLATE, Prompts
from dior_rt.files import reason
from dior_rt.training.backbone import resample
from dior_rt.training.fit import Plan, Progress, rendered, run
from dior_rt.training.light import (
    RELIT_SCALE,
    decode_lumi,
    draw_lumi,
    pack_patches,
    undraw_lumi,
    unpack_patches,
)

MULTIPLE: Final = 32
LOCAL: Final[dict[str, Any]] = {"local_files_only": True, "use_safetensors": True}
DEFAULT_PROMPTS: Final = {MODES["relight"]: Prompts.relight, MODES["estimate"]: Prompts.estimate}
ADAPTER: Final = "light"
TARGETS: Final = [
    *(f"to_{role}" for role in ("q", "k", "v", "out.0", "add_out")),
    *(f"add_{role}_proj" for role in "qkv"),
    *(f"{stream}_mlp.net.{layer}" for stream in ("img", "txt") for layer in ("0.proj", "2")),
]

UNREAD: Final = ["attn.add_q_proj", "attn.to_add_out", "txt_mlp.net.0.proj", "txt_mlp.net.2"]


class Qwen(nn.Module):
    """The transformer with its LoRA: velocity of latents (B, z, h, w) under references of the same shape."""

    def __init__(self, transformer: Any, prompts: dict[int, Tensor], rank: int) -> None:
        """transformer: a QwenImageTransformer2DModel. prompts: mode -> embeddings (T, D)."""
        super().__init__()
        self.transformer = transformer.requires_grad_(False)
        self.transformer.enable_gradient_checkpointing()
        last = f"transformer_blocks.{len(transformer.transformer_blocks) - 1}."
        self.lora = LoraConfig(
            r=rank,
            lora_alpha=rank,
            target_modules=TARGETS,
            # No output depends on what the last block does to the words.
            exclude_modules=[last + name for name in UNREAD],
            init_lora_weights="gaussian",
        )
        self.transformer.add_adapter(self.lora, adapter_name=ADAPTER)
        cast_training_params(self.transformer)  # to float32, whatever the dtype of the weights beneath
        self.prompts = nn.ParameterDict({str(k): nn.Parameter(v, False) for k, v in prompts.items()})

    def forward(
        self, x: Tensor, sigma: Tensor, photo: Tensor, light: Tensor, mask: Tensor, mode: Tensor
    ) -> Tensor:
        """Return the velocity. The mask is not used, because the light already contains it."""
        samples = zip(x, sigma, photo, light, mode.tolist(), strict=True)
        return torch.stack([self._one(*sample) for sample in samples])

    def _one(self, x: Tensor, sigma: Tensor, photo: Tensor, light: Tensor, mode: int) -> Tensor:
        """Return the velocity of one sample.

        The modes differ in the length of their prompts and the number of references.
        """
        pictures = [x, photo, light] if mode == MODES["relight"] else [x, photo]
        rows, columns = x.shape[1:]
        tokens = torch.cat([pack_patches(picture) for picture in pictures])
        velocity = self.transformer(
            hidden_states=tokens[None],
            encoder_hidden_states=self.prompts[str(mode)][None],
            timestep=sigma[None],
            img_shapes=[[(1, rows // 2, columns // 2)] * len(pictures)],
            return_dict=False,
        )[0][0, : rows * columns // 4]
        return unpack_patches(velocity, (rows // 2, columns // 2))

    def load(self, path: Path) -> None:
        """Load a LoRA that `save` wrote. Raises InputError for any other."""
        try:
            weights = {key.removeprefix("transformer."): value for key, value in load_file(path).items()}
            wanted = get_peft_model_state_dict(self.transformer, adapter_name=ADAPTER)
            shapes = ({key: value.shape for key, value in each.items()} for each in (weights, wanted))
            if next(shapes) != next(shapes):
                raise ValueError("it is of other layers, or of another rank")
        except (OSError, SafetensorError, ValueError) as error:
            raise InputError(f"Cannot go on from the LoRA {path}: {reason(error)}.") from error
        set_peft_model_state_dict(self.transformer, weights, adapter_name=ADAPTER)

    def save(self, folder: Path) -> None:
        """Write the LoRA as diffusers reads it, pytorch_lora_weights.safetensors with its settings."""
        QwenImageEditPlusPipeline.save_lora_weights(
            folder,
            transformer_lora_layers=get_peft_model_state_dict(self.transformer, adapter_name=ADAPTER),
            transformer_lora_adapter_metadata=self.lora.to_dict(),
        )


class Pictures:
    """An AutoencoderKLQwenImage, which converts batches of triplets to batches of latents of `area`
    pixels.
    """

    def __init__(self, vae: Any, area: int) -> None:
        self.vae, self.area = vae.requires_grad_(False).eval(), area
        self.mean, self.std = (
            torch.tensor(values)[:, None, None]
            for values in (vae.config.latents_mean, vae.config.latents_std)
        )

    def prepare(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Convert photo, light, mask, mode and x0 of mini to latents under the same names."""
        photo, mode = batch["photo"], batch["mode"][:, None, None, None]
        relit = photo + batch["x0"] / RELIT_SCALE
        lumi = draw_lumi(decode_lumi((batch["x0"] + 1) / 2))
        painted = torch.where(mode == MODES["relight"], relit, lumi)
        light = draw_lumi(batch["light"]) * (batch["mask"] > 0)
        latents = {"x0": painted, "photo": photo, "light": light}
        # This network has no estimate of the photo's own light that could be compared.
        kept = {name: value for name, value in batch.items() if name != "own"}
        return {**kept, **{name: self.encode(picture) for name, picture in latents.items()}}

    def lumi(self, x0: Tensor, grid: tuple[int, int]) -> Tensor:
        """Return the light on a grid from latents of drawn light, (B, 3, h, w), linear."""
        return resample(undraw_lumi(self.decode(x0)), grid)

    @torch.no_grad()
    def encode(self, pictures: Tensor) -> Tensor:
        """Return the latents (B, z, h', w'), normalised, of sRGB 0..1 (B, 3, h, w), resized to the area."""
        size = fit_area(self.area, pictures.shape[2], pictures.shape[3], MULTIPLE)
        self.vae.to(pictures.device)
        with torch.autocast(pictures.device.type, enabled=False):
            pixels = F.interpolate(pictures.float().clamp(0, 1), size, mode="bicubic", antialias=True)
            latents = self.vae.encode(2 * pixels.clamp(0, 1)[:, :, None] - 1).latent_dist.mode()[:, :, 0]
        return (latents - self.mean.to(latents)) / self.std.to(latents)

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Return the picture of latents at the size of the area: the inverse of `encode`."""
        self.vae.to(latents.device)
        with torch.autocast(latents.device.type, enabled=False):
            z = latents.float() * self.std.to(latents.device) + self.mean.to(latents.device)
            pixels = self.vae.decode(z[:, :, None]).sample[:, :, 0]
        return ((pixels + 1) / 2).clamp(0, 1)


class QwenLora:
    """The `Backbone` of Qwen: a diffusers folder with a LoRA in training, which the folder `out` receives."""

    def __init__(
        self,
        folder: Path,
        out: Path,
        rank: int,
        prompts: dict[int, Tensor] | None = None,
        area: int = 512**2,
        start: Path | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        """Load the model. prompts: mode -> embeddings (T, D); None takes those of the export's prompts.

        area: pixels of the pictures. start: a LoRA from which training continues. dtype: of the weights
        beneath the LoRA.

        Raises InputError for a folder that is not such a model, and for a LoRA that `save` did not write.
        """
        prompts = prompts or embed_prompts(folder)
        try:
            weights = folder / "transformer"
            transformer = QwenImageTransformer2DModel.from_pretrained(weights, torch_dtype=dtype, **LOCAL)
            vae = AutoencoderKLQwenImage.from_pretrained(folder / "vae", **LOCAL)
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(f"Cannot read the model in {folder}: {reason(error)}.") from error
        self.out, self.pictures = out, Pictures(vae, area)
        self.network = Qwen(transformer, prompts, rank)
        if start:
            self.network.load(start)

    def prepare(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        return self.pictures.prepare(batch)

    def lumi(self, x0: Tensor, grid: tuple[int, int]) -> Tensor:
        return self.pictures.lumi(x0, grid)

    def save(self, network: nn.Module) -> None:
        assert isinstance(network, Qwen)
        network.save(self.out)


def fit_qwen_lora(
    folder: Path,
    renders: Path,
    out: Path,
    rank: int,
    plan: Plan,
    prompts: dict[int, Tensor] | None = None,
    area: int = 512**2,
    progress: Progress | None = None,
) -> None:
    """Train a LoRA on a diffusers folder of Qwen-Image-Edit. `out` receives it, and a state to resume from.

    Arguments and errors are those of `QwenLora` and `fit`.
    """
    torch.manual_seed(plan.seed)
    stream = rendered(renders, plan)  # before the weights, which take minutes to read
    backbone = QwenLora(folder, out, rank, prompts, area, dtype=dtype_of(plan))
    run(backbone.network, stream, out, plan, progress, backbone.save, backbone.prepare)


def dtype_of(plan: Plan) -> torch.dtype:
    """Return the dtype of the weights that are not trained."""
    return torch.bfloat16 if plan.precision == "bf16" else torch.float32


@torch.no_grad()
def embed_prompts(folder: Path, prompts: dict[int, str] = DEFAULT_PROMPTS) -> dict[int, Tensor]:
    """Return the embeddings (T, D) of each mode's prompt in the model's template, without its first words.

    Raises InputError where the folder has no text encoder.
    """
    try:
        if not (folder / "tokenizer").is_dir():  # or transformers would look for it online
            raise FileNotFoundError(f"there is no folder {folder / 'tokenizer'}")
        tokenizer = Qwen2Tokenizer.from_pretrained(folder / "tokenizer", local_files_only=True)
        encoder = Qwen2_5_VLForConditionalGeneration.from_pretrained(folder / "text_encoder", **LOCAL)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"Cannot read the text encoder in {folder}: {reason(error)}.") from error
    embeddings = {}
    for mode, words in prompts.items():
        tokens = tokenizer(TEMPLATE.format(words), return_tensors="pt")
        hidden = encoder(**tokens, output_hidden_states=True).hidden_states[-1]
        embeddings[mode] = hidden[0, SKIP:].float()
    return embeddings
