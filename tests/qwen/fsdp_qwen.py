"""Train the tiny Qwen's LoRA for a few steps in one process, or sharded over several: one rank's part."""

from __future__ import annotations

import json
import os
import sys
from datetime import timedelta
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import tiny_qwen
import torch
import torch.distributed as dist
from torch.distributed.device_mesh import init_device_mesh
from torch.distributed.fsdp import fully_shard

from dior_rt.families.mini import MODES
from dior_rt.training.qwen import Qwen

STEPS, BATCH = 4, 4


def train(rank: int, ranks: int) -> list[float]:
    """The loss of each step, over the whole batch, of which each rank has an equal share."""
    torch.manual_seed(0)
    prompts = {mode: torch.randn(5, 32) for mode in MODES.values()}
    network = Qwen(tiny_qwen.transformer(), prompts, rank=4)
    if ranks > 1:
        mesh = init_device_mesh("cpu", (ranks,))
        for block in network.transformer.transformer_blocks:
            fully_shard(block, mesh=mesh)
        fully_shard(network.transformer, mesh=mesh)
        held = sum(weight.to_local().numel() for weight in network.transformer.parameters())
        whole = sum(weight.numel() for weight in network.transformer.parameters())
        assert held < 0.6 * whole, "the weights are not sharded"
    weights = [weight for weight in network.parameters() if weight.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=1e-2)
    batch = {name: torch.randn(BATCH, 4, 8, 8) for name in ("x", "photo", "light", "target")}
    sigma, share = torch.linspace(0.2, 0.9, BATCH), slice(rank * BATCH // ranks, (rank + 1) * BATCH // ranks)
    mode = torch.full((BATCH,), MODES["relight"])
    losses = []
    for _ in range(STEPS):
        velocity = network(
            batch["x"][share],
            sigma[share],
            batch["photo"][share],
            batch["light"][share],
            torch.ones(BATCH, 1, 8, 8)[share],
            mode[share],
        )
        loss = (velocity - batch["target"][share]).square().mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        mean = loss.detach().clone()
        if ranks > 1:
            dist.all_reduce(mean)
            mean /= ranks
        losses.append(float(mean))
    return losses


def main() -> None:
    rank, ranks, out = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"]), Path(sys.argv[1])
    torch.set_num_threads(1)
    if ranks > 1:
        dist.init_process_group("gloo", timeout=timedelta(minutes=10))
    losses = train(rank, ranks)
    if rank == 0:
        out.write_text(json.dumps(losses))
    if ranks > 1:
        dist.destroy_process_group()


if __name__ == "__main__":
    main()
