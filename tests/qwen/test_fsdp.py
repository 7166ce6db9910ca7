"""The large model's training sharded over processes (FSDP) does what one process does."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest


def launch(ranks: int, out: Path) -> list[float]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    script = Path(__file__).with_name("fsdp_qwen.py")
    world = {"WORLD_SIZE": str(ranks), "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "HF_HUB_OFFLINE": "1"}
    processes = [
        subprocess.Popen(
            [sys.executable, script, out],
            env={**os.environ, **world, "RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(ranks)
    ]
    for process in processes:
        _, said = process.communicate(timeout=600)
        assert process.returncode == 0, said
    return json.loads(out.read_text())


@pytest.mark.slow
def test_two_processes_with_half_the_weights_each_have_the_loss_of_one(tmp_path: Path) -> None:
    one, two = launch(1, tmp_path / "one.json"), launch(2, tmp_path / "two.json")
    assert one[-1] < one[0]  # it learns
    np.testing.assert_allclose(two, one, rtol=1e-4)
