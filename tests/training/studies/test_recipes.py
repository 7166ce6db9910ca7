"""The recipes: rows of equal cost, a flow about an estimate, severed patches, and walks of the flow."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from dior_rt.cli import run
from dior_rt.export.mini import MiniExportConfig, export_network
from dior_rt.kernels import Strokes
from dior_rt.relight import Relighter
from dior_rt.training.data.triplets import Batches
from dior_rt.training.fit import STATE, Plan, draw_noise_strength, flow_loss
from dior_rt.training.network import WEIGHTS, Config, Mini, load_network
from dior_rt.training.studies import recipes
from dior_rt.training.studies.ablation import AHEAD, GRID, Network, Walk
from dior_rt.training.studies.recipes import (
    HALF,
    ONCE,
    RECIPES,
    Recipe,
    Shared,
    at_equal_cost,
    cost,
    step_cost,
    study,
)
from dior_rt.training.studies.variants import AboutEstimate, sever

TINY = Config(width=32, depth=1, heads=2, patch=4, fine=8, half=16, quarter=32)
SHORT = Plan(steps=4, batch=2, warmup=1, average=1, rate=4e-3, grids=((16, 16),))


def noisy_mini(seed: int) -> Mini:
    """A network whose every weight says something."""
    torch.manual_seed(seed)
    network = Mini(TINY)
    with torch.no_grad():
        for weight in network.parameters():
            weight += 0.02 * torch.randn_like(weight)
    return network.eval()


@pytest.fixture(scope="module")
def batch(views):
    return next(iter(Batches(views, 4, seed=5, grids=((16, 16),))))


def seen(batch) -> dict[str, torch.Tensor]:
    return {name: batch[name] for name in ("photo", "light", "mask", "mode")}


@torch.no_grad()
def answer(network, batch, sigma: float, noise) -> torch.Tensor:
    """x0 as a network sees it in a state between the truth and noise."""
    x = (1 - sigma) * batch["x0"] + sigma * noise
    return x - sigma * network(x=x, sigma=torch.full((len(x),), sigma), **seen(batch))


@pytest.mark.slow
def test_the_same_walk_as_the_runtimes(tmp_path) -> None:
    network, random = noisy_mini(0), np.random.default_rng(0)
    photo = random.integers(0, 256, (48, 64, 3), np.uint8)
    mask = np.zeros((48, 64), np.float32)
    mask[10:20, 30:50] = 1
    strokes = Strokes((random.uniform(0, 2, (48, 64, 3)) * mask[..., None]).astype(np.float32), mask)
    exported = MiniExportConfig(name="small", grid=GRID, steps=5, guidance=1.0, noise_scale=0.5)
    bundle = export_network(network, exported, tmp_path / "small", weights="fp32")
    expected = np.asarray(Relighter(bundle.folder, ops="numpy").relight(photo, strokes, seed=3).picture)
    got = Network(network, Walk(5, 0.5, seed=3)).relight(photo, strokes)
    assert np.abs(got - expected.astype(int)).max() <= 1
    other = Network(network, Walk(5, 0.5, seed=4)).relight(photo, strokes)
    assert np.abs(other - expected.astype(int)).max() > 5
    # At sigma = 1 the state is not looked at, which is why no row is judged by one step from noise.
    one, silent = (Network(network, walk).relight(photo, strokes) for walk in (Walk(1, 1.0), ONCE))
    assert np.abs(one.astype(int) - silent).max() <= 1


def test_a_flow_about_its_own_estimate_starts_at_it(batch) -> None:
    network = noisy_mini(1)
    about = AboutEstimate(network, network)
    noise = torch.randn(batch["x0"].shape, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(answer(about, batch, 1.0, noise), answer(network, batch, 1.0, noise))


def test_a_flow_about_an_estimate_is_the_flow_of_what_that_leaves_open(batch) -> None:
    """In z = x - (1 - sigma) m, with velocities of a Gaussian about the answer less m, in float64."""
    estimate, flow, sigma = noisy_mini(1), noisy_mini(2), 0.7
    noise = torch.randn(batch["x0"].shape, generator=torch.Generator().manual_seed(0))
    got = answer(AboutEstimate(estimate, flow), batch, sigma, noise).double()
    middle = answer(estimate, batch, 1.0, noise)
    z = (1 - sigma) * (batch["x0"] - middle) + sigma * noise
    with torch.no_grad():
        relit = z - sigma * flow(x=z, sigma=torch.full((4,), sigma), **seen(batch))
    # What the flow expects, out of the mean that it makes of it and of z: Bayes' rule for two Gaussians.
    spread, rest = 0.25, 1 - sigma
    whole = rest**2 * spread + sigma**2
    expected = (relit.double() * whole - rest * spread * z.double()) / sigma**2
    left = (rest * spread * z.double() + sigma**2 * (expected - middle.double())) / whole
    torch.testing.assert_close(got, middle.double() + left, rtol=0, atol=1e-4)
    assert (got - relit).abs().max() > 0.01


def test_the_estimate_stays_and_the_flow_learns(batch) -> None:
    about = AboutEstimate(noisy_mini(1), noisy_mini(1))
    flow_loss(
        about, batch, torch.full((4,), 0.5), torch.zeros_like(batch["x0"]), source_weight=0.25
    ).backward()
    assert all(weight.grad is None for weight in about.estimate.parameters())
    assert all(weight.grad is not None for weight in about.flow.parameters())


def test_severed_cells_see_nothing_of_their_neighbours_tokens(batch) -> None:
    """A token that is changed changes its own cells alone; unsevered, also those next to them. Nothing is
    drawn: light that is reaches beside strokes by other ways."""
    batch = batch | {name: torch.zeros_like(batch[name]) for name in ("light", "mask")}
    for severed in (True, False):
        network = noisy_mini(3)
        if severed:
            sever(network)
        plain = answer(network, batch, 1.0, batch["x0"])
        network.divide_tokens.register_forward_pre_hook(
            lambda _, given: (
                given[0] + 3 * torch.nn.functional.pad(torch.ones(1, 32, 1, 1), (1, 2, 1, 2)),
                given[1],
            )
        )
        changed = (answer(network, batch, 1.0, batch["x0"]) != plain).any(dim=1).any(dim=0)
        own = torch.zeros(16, 16, dtype=torch.bool)
        own[4:8, 4:8] = True
        assert changed[own].any()
        assert changed[~own].any() == (not severed)


def test_equal_cost_is_equal_whatever_the_network() -> None:
    plan = replace(SHORT, steps=1000)
    plans = at_equal_cost(plan, TINY, RECIPES)
    costs = {recipe: cost(recipe, plans, TINY).flops for recipe in RECIPES}
    for recipe, flops in costs.items():
        assert flops == pytest.approx(costs[RECIPES[0]], rel=0.01), recipe.name
    assert plans[RECIPES[0]].steps == 1000 and plans[HALF].steps == 500
    by_name = {recipe.name: plans[recipe].steps for recipe in RECIPES}
    assert by_name["what ships, twice as wide"] < 1000 < by_name["what ships, patch 8"]
    assert by_name["estimate, then a flow about it"] < by_name["regression, then noise start"] == 500


def test_a_steps_cost_is_that_of_its_products() -> None:
    """Against the count by hand: two operations a weight and position, and as many for its gradient."""

    class Linear(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.mix = torch.nn.Conv2d(3, 3, 1, bias=False)

        def forward(self, x, with_source=False, **given):
            return self.mix(x), x

    # The state needs no gradient, so the way back is as dear as the way there.
    assert step_cost(Linear(), SHORT) == 2 * (2 * 3 * 3) * 2 * 16 * 16


def test_noise_of_a_strength() -> None:
    drawn = draw_noise_strength(
        1000, Plan(steps=1, noiseless=0.3, noise=0.25), torch.Generator().manual_seed(0)
    )
    assert set(drawn.flatten().tolist()) == {0.0, 0.25}
    assert float((drawn == 0).float().mean()) == pytest.approx(0.3, abs=0.05)


FEW = (
    RECIPES[0],
    Recipe("noise", noiseless=0, always_noise=0, walks=(ONCE, Walk(2, 1.0))),
    Recipe("warm", noiseless=0, always_noise=0, share=0.5, after=HALF),
    Recipe("about", noiseless=0, always_noise=0, share=0.5, after=HALF, about=True),
    Recipe("severed", blended=False),
)


@pytest.mark.slow
def test_every_row_is_trained_once_and_judged_by_the_same_pictures(renders, tmp_path) -> None:
    seen = []
    first = replace(FEW[0], walks=(ONCE,))
    rows = (first, *FEW[1:])
    evaluation, examples = study(
        renders, renders, tmp_path, SHORT, TINY, rows, lambda *told: seen.append(told[0])
    )
    plans = at_equal_cost(SHORT, TINY, rows)
    assert seen == list(range(1, sum(plan.steps for plan in plans.values()) + 1))
    assert {path.name for path in tmp_path.iterdir()} == {recipe.folder for recipe in plans}
    answers, brush = evaluation.tables
    assert [row.method for row in brush.rows] == [recipe.name for recipe in rows]
    assert answers.pictures == 12 and brush.pictures == 6 and len(examples) == 2 * len(rows)
    shown = {(row.method, row.control): row.figures for row in answers.rows}
    assert len(shown) == 2 * (len(rows) + 2)  # one row walks twice, and the copy
    for drawn in ("dense", "strokes"):
        base = shown["what ships", f"{drawn}, 1 step without noise"]
        assert base[AHEAD].mean == base[AHEAD].high == 0
        for (_, control), figures in shown.items():
            if control.startswith(drawn):
                assert figures[AHEAD].mean == pytest.approx(figures["PSNR"].mean - base["PSNR"].mean)
    # All began alike, and learnt different things; what was severed is still so.
    networks = {recipe: load_network(tmp_path / recipe.folder / WEIGHTS) for recipe in plans}
    assert len({network.head.weight.sum().item() for network in networks.values()}) == len(plans)
    assert networks[rows[4]].head.weight[:, :, 1, 1].any()
    assert torch.count_nonzero(networks[rows[4]].head.weight) == 9 * TINY.fine

    again, _ = study(renders, renders, tmp_path, SHORT, TINY, rows, lambda *told: seen.append(told[0]))
    assert again == evaluation and len(seen) == seen[-1]


@pytest.mark.slow
def test_a_stopped_study_goes_on_with_the_batches_it_had_not_seen(renders, tmp_path) -> None:

    def stop(step: int, loss: float) -> None:
        if step == 3:
            raise KeyboardInterrupt

    plan, rows = replace(SHORT, save_every=1), FEW[:1]
    study(renders, renders, tmp_path / "through", plan, TINY, rows)
    with pytest.raises(KeyboardInterrupt):
        study(renders, renders, tmp_path / "stopped", plan, TINY, rows, stop)
    study(renders, renders, tmp_path / "stopped", plan, TINY, rows)
    whole, resumed = (load_file(tmp_path / name / rows[0].folder / STATE) for name in ("through", "stopped"))
    for name, tensor in whole.items():
        torch.testing.assert_close(resumed[name], tensor, rtol=1e-5, atol=1e-7)


def test_what_goes_on_sees_the_batches_after_those_before_it(views) -> None:
    def drawn():
        return iter(Batches(views, 2, seed=0, grids=((16, 16),)))

    plans = at_equal_cost(SHORT, TINY, FEW)
    shared = Shared(drawn())
    before, after = (list(shared.after(plans, recipe)(0, 0)) for recipe in (HALF, FEW[2]))
    assert len(before) == len(after) == 2
    for got, expected in zip(before + after, drawn(), strict=False):
        assert all(torch.equal(got[name], expected[name]) for name in expected)
    assert [batch["x0"].sum() for batch in shared.after(plans, FEW[2])(1, 0)] == [after[1]["x0"].sum()]
    assert list(shared.after(plans, FEW[2])(2, 0)) == []


@pytest.mark.slow
def test_the_command_writes_what_it_measured(renders, tmp_path, capfd, monkeypatch) -> None:
    small = {"small": TINY, "recipes": (replace(FEW[0], walks=(ONCE,)), FEW[4])}
    for name in ("study", "total_steps"):
        monkeypatch.setattr(recipes, name, partial(getattr(recipes, name), **small))
    out = tmp_path / "study"
    command = ["train", "recipes", str(renders), str(renders), "--out", str(out), "--steps", "2"]
    assert run(command) == 0
    told = capfd.readouterr()
    assert "| severed | strokes, 1 step without noise |" in told.out
    assert "step 4/4" in told.err
    assert {"report.json", "report.md", "contact.png"} <= {path.name for path in out.iterdir()}


def test_folders_without_renders(renders, tmp_path, capfd) -> None:
    for folders in ((tmp_path, renders), (renders, tmp_path)):
        command = ["train", "recipes", *map(str, folders), "--out", str(tmp_path / "study"), "--batch", "1"]
        assert run(command) == 2
        assert f"There are no renders in {tmp_path}" in capfd.readouterr().err
    assert not (tmp_path / "study").exists()
