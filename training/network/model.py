"""Mini's network: a diffusion transformer on the light grid that predicts light, not colours.

Convolutions see photo and strokes, a plain DiT works on tokens of 8 x 8 cells, and convolutions blend its
answer across the tokens' borders. The heads are physical. To relight, a log-ratio r a cell and channel,

    relit = (photo + e) exp(r) - e        in linear light, e = 0.02

    r = raw + log((drawn + b) / (own + b))    under a stroke, b = 0.02: the light that has bounced
    r = raw + what strokes say elsewhere      beside strokes, as far as learnt gates let it reach

so a network that has learnt nothing returns the photo where nothing is drawn, black can still be lit, and
twice the drawn value is twice the light. `own`, the photo's own Lumi map, is the answer to estimate; it is
taken from the photo alone, before the strokes are seen. The velocity is that of a narrow Gaussian about the
answer.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional as F

from dior_rt.errors import InputError
from dior_rt.files import check_readable, reason, replacing

Turns = tuple[Tensor, Tensor]  # cosine and sine of every token's place

# The files of a checkpoint: what training writes and export reads.
WEIGHTS = "model.safetensors"
LORA = "lora"

FLOOR = 0.02  # e above: what a ratio is guarded with where the photo is black
RELIT_SCALE = 4.0
LUMI_SCALE = 8.0
BOUNCED = 0.02  # light where no source shines: it has bounced there, and drawn darkness is no black hole
BRIGHTEST = 4.0  # of the encoded light: 820 times white, far below what overflows
LITTLE = 0.01  # of the cells around drawn: half of what is said there holds
EDGE = 3.0  # cells: how softly what is drawn ends beside a stroke
TOUCHED = 0.15  # of the cells within that reach drawn: half of what is said there holds
CLOSED = 2.0  # gates begin an eighth open
LARGEST_LOGIT = 8.0
MURK = 0.1  # noise ten times as strong as the image hides half of the state
DEVIATION = 0.5  # of x0 from what the network expects: some 0.12 in sRGB


@dataclass(frozen=True)
class Config:
    """The network's size. width: of a token, a multiple of 4 heads; patch: a token's side, in cells, a
    multiple of 4; fine, half, quarter: features of a cell, of 2 x 2, and of 4 x 4 cells.

    Raises InputError for a width that the heads do not divide so, and for such a patch.
    """

    width: int = 256
    depth: int = 8
    heads: int = 8
    patch: int = 8
    fine: int = 16
    half: int = 64
    quarter: int = 128

    def __post_init__(self) -> None:
        if self.width % (4 * self.heads):
            raise InputError(f"The width must be a multiple of 4 times the heads; {self.width} is none.")
        if self.patch % 4:
            raise InputError(f"The patch must be a multiple of 4; {self.patch} is none.")


def srgb_to_linear(encoded: Tensor) -> Tensor:
    """IEC 61966-2-1, for values in 0..1."""
    return torch.where(
        encoded <= 0.04045, encoded / 12.92, ((encoded.clamp_min(0.04) + 0.055) / 1.055) ** 2.4
    )


def linear_to_srgb(linear: Tensor) -> Tensor:
    """IEC 61966-2-1, for values in 0..1; its straight foot goes on below 0."""
    return torch.where(
        linear <= 0.0031308,
        12.92 * linear,
        1.055 * linear.clamp_min(0.003) ** (1 / 2.4) - 0.055,
    )


def encode_light(light: Tensor) -> Tensor:
    """log(1 + 8 L) / log 9: 0 to 0, 1 to 1, and room for light a thousand times stronger."""
    return torch.log1p(LUMI_SCALE * light) / math.log1p(LUMI_SCALE)


def decode_light(encoded: Tensor) -> Tensor:
    return torch.expm1(encoded.clamp_min(0) * math.log1p(LUMI_SCALE)) / LUMI_SCALE


def spread(drawn: Tensor, deviation: float) -> Tensor:
    """What the strokes say on average around every cell, and how much is drawn there.

    drawn: (B, 4, h, w), values that are 0 where the mask, the last channel, is. Returns (B, 4, h, w), the
    means over what is drawn, and 0 for nothing drawn, towards 1 from a hundredth of the cells on.
    """
    return _of_what_is_drawn(around(drawn, deviation))


def spread_everywhere(drawn: Tensor) -> Tensor:
    """As `spread`, over the whole picture."""
    return _of_what_is_drawn(everywhere(drawn).expand_as(drawn))


def around(cells: Tensor, deviation: float) -> Tensor:
    """The mean around every cell, (B, C, h, w) to the same, by a Gaussian of that many cells."""
    down, along = (_gaussian(size, deviation, cells) for size in cells.shape[2:])
    return down @ cells @ along.T


def _gaussian(size: int, deviation: float, like: Tensor) -> Tensor:
    """(size, size): row i are the weights of all cells for cell i, 1 in sum."""
    place = torch.arange(size, dtype=like.dtype, device=like.device)
    weights = torch.exp(-0.5 * ((place[:, None] - place) / deviation) ** 2)
    return weights / weights.sum(dim=1, keepdim=True)


def even(cells: Tensor) -> Tensor:
    """Every cell mixed with its neighbours by 1, 2, 1 both ways, (B, C, h, w) to the same.

    Cells that are made of one get weights each of their own, and what these differ by would show in an even
    sky as a weave; of two cells' period nothing is left.
    """
    return F.avg_pool2d(F.avg_pool2d(F.pad(cells, (1, 1, 1, 1), mode="replicate"), 2, 1), 2, 1)


def everywhere(cells: Tensor) -> Tensor:
    """The mean of the whole picture: (B, C, h, w) to (B, C, 1, 1)."""
    return cells.mean(dim=(2, 3), keepdim=True)


def _of_what_is_drawn(means: Tensor) -> Tensor:
    return means / (means[:, 3:] + LITTLE)


def velocity(x: Tensor, sigma: Tensor, expected: Tensor) -> Tensor:
    """E[eps - x0 | x] where x = (1 - sigma) x0 + sigma eps, and x0 is Gaussian about `expected`.

    So the answer rests on `expected` near noise and on the state near the image, and no sigma is divided by.
    """
    rest, variance = 1 - sigma, DEVIATION**2
    return ((sigma - rest * variance) * x - sigma * expected) / (rest**2 * variance + sigma**2)


class Features(NamedTuple):
    """What does not depend on the flow. given: photo, photo in linear light, its light if it were white
    paper (encoded), and the drawn light over the photo's own, as logarithms: under strokes, then on average
    of those nearby, farther off and everywhere for the cells beside them; cosine, sine: of the tokens'
    places, see `rotations`; the others are what convolutions see."""

    given: Tensor  # (B, 21, h, w)
    fine: Tensor  # (B, 16, h, w)
    half: Tensor  # (B, 64, h / 2, w / 2)
    quarter: Tensor  # (B, 128, h / 4, w / 4)
    tokens: Tensor  # (B, width, h / patch, w / patch)
    cosine: Tensor  # (B, h / patch, w / patch, width / heads / 2)
    sine: Tensor


class Mini(nn.Module):
    """photo, strokes, noisy state -> velocity. Inputs and output as in docs/contracts.md.

    `encode` looks at photo and strokes, once a picture; `step` is what every step of the flow costs.
    """

    def __init__(self, config: Config) -> None:
        super().__init__()
        self.config = config
        width, patch = config.width, config.patch
        fine, half, quarter = config.fine, config.half, config.quarter
        self.see = nn.Conv2d(18, fine, 3, padding=1)
        self.see_half = nn.Conv2d(fine, half, 4, 2, 1)
        self.see_quarter = nn.Conv2d(half, quarter, 4, 2, 1)
        self.refine = Refine(quarter)
        self.embed = nn.Conv2d(quarter, width, patch // 4, patch // 4)
        self.embed_state = nn.Conv2d(3, width, patch, patch)
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.mode = nn.Embedding(2, width)
        self.modulation = nn.Linear(width, 6 * width)
        self.blocks = nn.ModuleList(Block(config) for _ in range(config.depth))
        self.unembed = nn.Linear(width, quarter * (patch // 4) ** 2)
        self.divide_tokens = DivideTokens(patch // 4)
        self.blend_quarter = Blend(quarter, half)
        self.blend_half = Blend(half, fine)
        self.see_state = nn.Conv2d(3, fine, 3, padding=1)
        self.state_gate = nn.Linear(width, fine)
        self.smooth = nn.Conv2d(fine, fine, 3, padding=1)
        self.head = nn.Conv2d(fine, 9, 3, padding=1)
        self.mix: nn.Module = Even()
        for silent in (self.modulation, self.state_gate, self.head):
            for weight in silent.parameters():
                nn.init.zeros_(weight)

    def forward(
        self,
        x: Tensor,
        sigma: Tensor,
        photo: Tensor,
        light: Tensor,
        mask: Tensor,
        mode: Tensor,
        own: Tensor | None = None,
        with_own: bool = False,
    ) -> Tensor | tuple[Tensor, Tensor]:
        """The velocity; and, where asked for, what the network takes for the photo's own light, encoded.

        own: that light, where it is known from a call before.
        """
        own = self.own_light(photo) if own is None else own
        towards = self.step(x, sigma, mode, *self.encode(photo, light, mask, own))
        return (towards, own) if with_own else towards

    def own_light(self, photo: Tensor) -> Tensor:
        """(B, 3, h, w) the light on a photo, encoded: the estimate, without strokes and from a silent state.

        Were the strokes seen, the answer would lean towards them, since light that is drawn tends to be like
        the light that is there; and twice the light drawn would be less than twice the light.
        """
        none, sigma = torch.zeros_like(photo), torch.ones_like(photo[:, 0, 0, 0])
        blank = self.encode(photo, none, none[:, :1], none)
        return self._answers(none, sigma, sigma.long(), blank)[1]

    def encode(self, photo: Tensor, light: Tensor, mask: Tensor, own: Tensor) -> Features:
        """What photo and strokes say, whatever the flow's state; own: the light on the photo, encoded."""
        linear = srgb_to_linear(photo)
        white, aim = encode_light(linear), torch.log(LUMI_SCALE * (light + BOUNCED))
        # Where the light would have to go on white paper.
        start = aim - torch.log(LUMI_SCALE * (linear + BOUNCED))
        drawn = torch.cat([start * mask, mask], dim=1)  # (B, 4, h, w)
        said = [drawn, spread(drawn, self.config.patch), spread_everywhere(drawn)]
        seen = torch.cat([2 * photo - 1, encode_light(light) * mask, *said], dim=1)
        fine = F.silu(self.see(seen))
        half = F.silu(self.see_half(fine))
        quarter = self.refine(F.silu(self.see_quarter(half)))
        # Under a stroke the light is known: twice the value is twice the light, before anything is learnt.
        brightness = torch.exp(own.clamp(0.0, BRIGHTEST) * math.log1p(LUMI_SCALE))  # 1 + 8 light
        known = mask * (aim - torch.log(brightness - (1 - LUMI_SCALE * BOUNCED)))
        given = torch.cat([photo, linear, white, *self._said(known, mask)], dim=1)
        tokens = self.embed(quarter)
        batch, _, rows, columns = tokens.shape
        turns = rotations(rows, columns, self.config.width // self.config.heads, photo.device)
        cosine, sine = (turn.unflatten(0, (rows, columns)).expand(batch, -1, -1, -1) for turn in turns)
        return Features(given, fine, half, quarter, tokens, cosine, sine)

    def step(
        self,
        x: Tensor,
        sigma: Tensor,
        mode: Tensor,
        given: Tensor,
        fine: Tensor,
        half: Tensor,
        quarter: Tensor,
        tokens: Tensor,
        cosine: Tensor,
        sine: Tensor,
    ) -> Tensor:
        """The velocity at x and sigma, with what `encode` made of photo and strokes."""
        features = Features(given, fine, half, quarter, tokens, cosine, sine)
        relit, own = self._answers(x, sigma, mode, features)
        return _towards(relit, own, x, sigma, mode)

    def _answers(self, x: Tensor, sigma: Tensor, mode: Tensor, features: Features) -> tuple[Tensor, Tensor]:
        """The relit picture less the photo, as x0 has it, and the photo's own light, encoded."""
        given, fine, half, quarter, tokens, cosine, sine = features
        clear = clarity(sigma)
        heard = 1 - (1 - sigma) * clear  # where the state says nothing, neither does the time
        condition = F.silu(self.time(_twice(waves(heard, self.config.width))) + _twice(self.mode(mode)))
        turns = cosine.flatten(1, 2), sine.flatten(1, 2)  # (B, rows * columns, width / heads / 2)
        seen = x * clear[:, None, None, None]
        cells = self._transform(tokens + self.embed_state(seen), condition, turns)  # (B, 128, h / 4, w / 4)
        cells = self.blend_quarter(cells + quarter)  # (B, 64, h / 2, w / 2)
        cells = self.blend_half(cells + half)  # (B, 16, h, w)
        state = self.see_state(seen) * self.state_gate(condition)[: x.shape[0], :, None, None]
        cells = F.silu(self.smooth(cells + fine + state))
        raw, own, gates = self.mix(self.head(cells).float()).split(3, dim=1)  # (B, 3, h, w)
        photo, linear, white, known, nearby, farther, anywhere = given.split(3, dim=1)
        # Gates say how much of what is drawn nearby, farther off, and everywhere holds beside the strokes.
        near, far, wide = torch.sigmoid(gates - CLOSED).split(1, dim=1)
        ratio = raw + known + near * nearby + far * farther + wide * anywhere
        # Of white paper the light, encoded, is the photo itself.
        return _relight(photo, linear, ratio), white + own

    def _said(self, known: Tensor, mask: Tensor) -> list[Tensor]:
        """What is drawn under the strokes, going on beside them as it fades within a few cells; then what
        strokes say on average nearby, farther off and everywhere, for every cell that this leaves open."""
        beside, patch, drawn = 1 - mask, self.config.patch, torch.cat([known, mask], dim=1)
        touching, share = around(drawn, EDGE).split((3, 1), dim=1)
        left = beside * (TOUCHED / (share + TOUCHED))
        means = [spread(drawn, patch / 2), spread(drawn, patch), spread_everywhere(drawn)]
        said = [known + beside * (touching / (share + TOUCHED)), *(left * told[:, :3] for told in means)]
        # Where a stroke ends all this steps, and what is added to it in the end cannot: it is mixed with its
        # neighbours, and so is this there, or a thin line would be left about the stroke.
        mixed = even(mask)
        ends = 4 * mixed * (1 - mixed)
        return [plane + ends * (even(plane) - plane) for plane in said]

    def _transform(self, tokens: Tensor, condition: Tensor, turns: Turns) -> Tensor:
        """The transformer: (B, width, rows, columns) to features of every 4 x 4 cells.

        condition: (2 B, width), of which the first half counts.
        """
        rows, columns = tokens.shape[2:]
        tokens = tokens.flatten(2).transpose(1, 2)  # (B, rows * columns, width)
        # All blocks' at once, (B, depth * 6, width): six vectors are little to work on.
        about = torch.tensor([0.0, 1, 0, 0, 1, 0], device=tokens.device)[:, None]  # scales begin at 1
        offsets = torch.stack([block.get_parameter("offset") for block in self.blocks]) + about
        modulation = self.modulation(condition)[: tokens.shape[0]].unflatten(1, (1, 6, -1)) + offsets
        vectors = modulation.flatten(1, 2).split(1, dim=1)
        for index, block in enumerate(self.blocks):
            tokens = block(tokens, vectors[6 * index : 6 * index + 6], turns)
        tokens = _norm(tokens.unflatten(1, (rows, columns)))
        return self.divide_tokens(tokens.movedim(3, 1), self.unembed)


class Even(nn.Module):
    """`even`, as a part of the network that can be left out."""

    def forward(self, cells: Tensor) -> Tensor:
        return even(cells)


class DivideTokens(nn.Module):
    """A linear map makes of every token the cells that it covers: (B, width, rows, columns) to
    (B, C, factor * rows, factor * columns)."""

    def __init__(self, factor: int) -> None:
        super().__init__()
        self.factor = factor

    def forward(self, tokens: Tensor, unembed: nn.Module) -> Tensor:
        cells = unembed(tokens.movedim(1, 3)).movedim(3, 1)
        return F.pixel_shuffle(cells, self.factor)


class Divide(nn.Conv2d):
    """Every cell becomes four: (B, C, h, w) to (B, finer, 2 h, 2 w)."""

    def __init__(self, size: int, finer: int) -> None:
        super().__init__(size, 4 * finer, 1)

    def forward(self, cells: Tensor) -> Tensor:
        return F.pixel_shuffle(super().forward(cells), 2)


class Refine(nn.Module):
    """What the surroundings add to every cell's features: (B, C, h, w) to the same. Nothing at first."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.look, self.add = nn.Conv2d(size, size, 3, padding=1), nn.Conv2d(size, size, 3, padding=1)
        for weight in self.add.parameters():
            nn.init.zeros_(weight)

    def forward(self, cells: Tensor) -> Tensor:
        return cells + self.add(F.silu(self.look(cells)))


class Blend(nn.Module):
    """Neighbouring cells blended, so that no borders show, then each made four."""

    def __init__(self, size: int, finer: int) -> None:
        super().__init__()
        self.blend = nn.Conv2d(size, size, 3, padding=1)
        self.divide = Divide(size, finer)

    def forward(self, cells: Tensor) -> Tensor:
        return self.divide(F.silu(self.blend(cells)))


class Block(nn.Module):
    """Attention and MLP under adaptive norms; all blocks share the modulation, each adds its own offset."""

    def __init__(self, config: Config) -> None:
        super().__init__()
        width = config.width
        self.heads = config.heads
        self.offset = nn.Parameter(torch.zeros(6, width))
        self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, tokens: Tensor, modulation: Sequence[Tensor], turns: Turns) -> Tensor:
        shift1, scale1, gate1, shift2, scale2, gate2 = modulation  # (B, 1, width) each
        tokens = tokens + gate1 * self._attend(_norm(tokens) * scale1 + shift1, turns)
        hidden = F.gelu(self.up(_norm(tokens) * scale2 + shift2), approximate="tanh")
        return tokens + gate2 * self.down(hidden)

    def _attend(self, tokens: Tensor, turns: Turns) -> Tensor:
        q, k, v = (
            self.qkv(tokens).unflatten(2, (3, self.heads, -1)).permute(2, 0, 3, 1, 4).unbind(0)
        )  # (B, H, N, d)
        # Queries and keys of unit length keep the logits small, whatever the precision. Written out:
        # with so few tokens the fused attention's backward pass takes a multiple of the time on CPUs.
        turns = turns[0].unsqueeze(1), turns[1].unsqueeze(1)  # for all heads
        q, k = rotate(_unit(q), turns), rotate(LARGEST_LOGIT * _unit(k), turns)
        mixed = (q @ k.transpose(2, 3)).softmax(dim=-1) @ v
        return self.proj(mixed.transpose(1, 2).flatten(2))


def _norm(tokens: Tensor) -> Tensor:
    return F.layer_norm(tokens, tokens.shape[-1:])


def _unit(part: Tensor) -> Tensor:
    return F.normalize(part, dim=-1)


def clarity(sigma: Tensor) -> Tensor:
    """(B,) in 0..1: how far a state is looked at. Next to noise it can say nothing of the answer; what the
    network has answered so far, however faint in it, must not be taken for a word about the truth."""
    image, noise = (1 - sigma) ** 2, (MURK * sigma) ** 2
    return image / (image + noise)


def _twice(rows: Tensor) -> Tensor:
    """A product of one row is summed in another order than one of several; with every row twice a lone
    picture has the same last bits as in a batch."""
    return torch.cat([rows, rows])


def waves(sigma: Tensor, width: int) -> Tensor:
    """(B,) flow times to (B, width) sinusoids of 1 to 10 rad over 0..1.

    Finer waves would let the velocity change with sigma faster than a solver's steps can follow.
    """
    frequency = torch.exp(torch.linspace(0.0, math.log(10.0), width // 2, device=sigma.device))
    angle = sigma[:, None] * frequency
    return torch.cat([torch.cos(angle), torch.sin(angle)], dim=1)


def rotations(rows: int, columns: int, size: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Cosine and sine (rows * columns, size / 2) of the rotary position code (RoPE, arXiv 2104.09864).

    Half of it turns with the row, half with the column. Nothing is learnt, so any shape of grid works.
    """
    frequency = torch.exp(-math.log(100.0) * torch.arange(size // 4, device=device) / (size // 4))
    down = (torch.arange(rows, device=device)[:, None] * frequency)[:, None, :].expand(
        rows, columns, size // 4
    )
    along = (torch.arange(columns, device=device)[:, None] * frequency)[None, :, :].expand(
        rows, columns, size // 4
    )
    angle = torch.cat([down, along], dim=2).reshape(rows * columns, size // 2)
    return torch.cos(angle), torch.sin(angle)


def rotate(part: Tensor, turns: Turns) -> Tensor:
    """Turn the pairs (part[i], part[i + size / 2]) of (B, H, N, size) by their position's angles."""
    cosine, sine = turns
    a, b = part.chunk(2, dim=-1)
    return torch.cat([a * cosine - b * sine, a * sine + b * cosine], dim=-1)


def _towards(relit: Tensor, own: Tensor, x: Tensor, sigma: Tensor, mode: Tensor) -> Tensor:
    """The velocity towards what the mode asks for."""
    expected = torch.where(mode[:, None, None, None] == 0, relit, 2 * own - 1)
    return velocity(x, sigma[:, None, None, None], expected)


def _relight(photo: Tensor, linear: Tensor, ratio: Tensor) -> Tensor:
    ratio = 6 * torch.tanh(ratio / 6)  # at most 400 times the light, or a 400th
    relit = (linear + FLOOR) * torch.exp(ratio) - FLOOR
    # What lies outside the display's range is shown clipped, but a little slope keeps it trainable.
    shown = relit.clamp(0, 1)
    return RELIT_SCALE * (linear_to_srgb(shown) + 0.05 * (relit - shown).clamp(-1, 1) - photo)


def save_network(network: Mini, path: Path) -> None:
    """Weights as safetensors, the configuration in its header; written whole, or InputError raised."""
    weights = {name: weight.contiguous() for name, weight in network.state_dict().items()}
    with replacing(path) as file:
        file.write(save(weights, {"config": json.dumps(asdict(network.config))}))


def load_network(path: Path) -> Mini:
    """The network of a safetensors file written by `save_network`; half-precision weights become float32.

    Raises InputError for a file that is missing, cut short, or something else.
    """
    check_readable(path, "checkpoint")
    try:
        with safe_open(path, "pt") as file:
            network = Mini(Config(**json.loads((file.metadata() or {})["config"])))
        network.load_state_dict({name: weight.float() for name, weight in load_file(path).items()})
    except (OSError, SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path} is no checkpoint of mini: {reason(error)}.") from error
    return network.eval()
