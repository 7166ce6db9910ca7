"""What several parts are tested with: a small mini with random weights, and its bundle."""

import math
from pathlib import Path

import pytest


def small_network(seed: int = 0):
    """A DiT with mini's inputs and output, random weights."""
    import torch
    from torch import nn
    from torch.nn import functional as F

    class Block(nn.Module):
        def __init__(self, width, heads):
            super().__init__()
            self.heads = heads
            self.modulation = nn.Linear(width, 6 * width)
            self.qkv, self.proj = nn.Linear(width, 3 * width), nn.Linear(width, width)
            self.up, self.down = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

        def forward(self, x, c):
            b, n, d = x.shape
            a1, s1, g1, a2, s2, g2 = self.modulation(c)[:, None].chunk(6, -1)
            h = F.layer_norm(x, (d,)) * (1 + a1) + s1
            q, k, v = self.qkv(h).reshape(b, n, 3, self.heads, d // self.heads).permute(2, 0, 3, 1, 4)
            x = x + g1 * self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, d))
            return x + g2 * self.down(F.gelu(self.up(F.layer_norm(x, (d,)) * (1 + a2) + s2)))

    class Small(nn.Module):
        def __init__(self, width=48, patch=4):
            super().__init__()
            self.patch = patch
            self.embed = nn.Conv2d(10, width, patch, patch)
            self.mode, self.time = nn.Embedding(2, width), nn.Linear(1, width)
            self.blocks = nn.ModuleList([Block(width, 4), Block(width, 4)])
            self.head = nn.Linear(width, 3 * patch * patch)

        def forward(self, x, sigma, photo, light, mask, mode):
            seen = torch.cat([x, photo, torch.log1p(8 * light) / math.log(9) * mask, mask], 1)
            tokens = self.embed(seen)
            b, _, rows, columns = tokens.shape
            tokens = tokens.flatten(2).transpose(1, 2)
            c = F.silu(self.time(sigma[:, None]) + self.mode(mode))
            for block in self.blocks:
                tokens = block(tokens, c)
            cells = self.head(tokens).reshape(b, rows, columns, 3, self.patch, self.patch)
            x0 = cells.permute(0, 3, 1, 4, 2, 5).reshape(x.shape)
            return (x - x0) / sigma.clamp_min(1e-3)[:, None, None, None]

    torch.manual_seed(seed)
    return Small().eval()


@pytest.fixture
def network():
    return small_network()


@pytest.fixture(scope="session")
def recipe():
    from dior_rt.export.mini import Recipe

    from dior_rt.grid import GridRule
    from dior_rt.schedule import ShiftSchedule

    return Recipe("small", GridRule(1024, 4, 256), ShiftSchedule(8.0), steps=4, guidance=2.0, noise_scale=1.0)


@pytest.fixture(scope="session")
def mini_bundle(tmp_path_factory, recipe) -> Path:
    """The folder of a small mini's bundle; not to be changed."""
    from dior_rt.export.mini import export_network

    folder = tmp_path_factory.mktemp("bundles") / "small"
    export_network(small_network(), recipe, folder)
    return folder
