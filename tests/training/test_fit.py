"""Training: it learns, it goes on where it stopped, and a LoRA merged is the LoRA trained."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from peft import PeftModel
from safetensors.torch import load_file

from dior_rt.errors import InputError
from dior_rt.export.lora import merge_lora
from dior_rt.training.data.triplets import Batches
from dior_rt.training.fit import STATE, Plan, draw_sigma, fit, fit_lora, flow_loss, response_loss
from dior_rt.training.light import FLOOR, RELIT_SCALE, linear_to_srgb, srgb_to_linear
from dior_rt.training.network import BOUNCED, LORA, WEIGHTS, Config, Mini, load_network, save_network

TINY = Config(width=32, depth=1, heads=2, patch=8, fine=4, half=8, quarter=16)
SHORT = Plan(steps=6, batch=2, rate=2e-3, warmup=2, average=2, save_every=2)


def loss_of(network: torch.nn.Module, views) -> float:
    """The loss on batches that training never sees, all from pure noise."""
    batch = next(iter(Batches(views, 24, seed=99)))
    noise = torch.randn(batch["x0"].shape, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        return float(flow_loss(network, batch, torch.ones(24), noise))


@pytest.fixture(scope="module")
def trained(renders, tmp_path_factory) -> Path:
    """The folder of a short run."""
    out = tmp_path_factory.mktemp("run")
    fit(renders, out, TINY, Plan(steps=60, batch=6, rate=4e-3, warmup=5, average=5))
    return out


def test_the_loss_goes_down(trained, views) -> None:
    torch.manual_seed(0)
    before, after = loss_of(Mini(TINY), views), loss_of(load_network(trained / WEIGHTS), views)
    assert after < 0.9 * before


def test_a_stopped_run_goes_on_as_if_it_had_not(renders, tmp_path) -> None:
    through, stopped = tmp_path / "through", tmp_path / "stopped"
    fit(renders, through, TINY, SHORT)

    def stop(step: int, loss: float) -> None:
        if step == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(renders, stopped, TINY, SHORT, stop)
    seen = []
    fit(renders, stopped, TINY, SHORT, lambda step, loss: seen.append(step))
    assert seen == [5, 6]  # from the state of step 4
    for name in (WEIGHTS, STATE):
        whole, resumed = load_file(through / name), load_file(stopped / name)
        assert whole.keys() == resumed.keys()
        for key, tensor in whole.items():
            torch.testing.assert_close(resumed[key], tensor, rtol=1e-5, atol=1e-7)
    assert sorted(path.name for path in stopped.iterdir()) == sorted([WEIGHTS, STATE])


def test_a_finished_run_has_nothing_left_to_do(renders, trained) -> None:
    before = (trained / WEIGHTS).read_bytes()
    seen = []
    fit(renders, trained, TINY, Plan(steps=60, batch=6), lambda step, loss: seen.append(step))
    assert seen == [] and (trained / WEIGHTS).read_bytes() == before


def test_what_is_saved_is_the_average_of_the_weights(renders, tmp_path) -> None:
    fit(renders, tmp_path, TINY, SHORT)
    state, network = load_file(tmp_path / STATE), load_network(tmp_path / WEIGHTS)
    for k, weight in enumerate(network.parameters()):
        assert torch.equal(weight, state[f"{k}.average"])
    assert any(not torch.equal(weight, state[f"{k}.weight"]) for k, weight in enumerate(network.parameters()))


def test_a_run_of_another_network_is_not_taken_up(renders, trained) -> None:
    with pytest.raises(InputError, match="cannot go on: the network that it trained has another size"):
        fit(renders, trained, replace(TINY, width=64), Plan(steps=61, batch=2))


def test_a_damaged_state_is_not_taken_up(renders, tmp_path) -> None:
    (tmp_path / STATE).write_bytes(b"no state")
    with pytest.raises(InputError, match="cannot go on"):
        fit(renders, tmp_path, TINY, SHORT)


@pytest.mark.usefixtures("another_precision")
def test_bfloat16_trains_and_saves_single_precision(renders, tmp_path) -> None:
    losses = []
    fit(renders, tmp_path, TINY, replace(SHORT, precision="bf16"), lambda step, loss: losses.append(loss))
    assert len(losses) == SHORT.steps and all(0 < loss < 10 for loss in losses)
    assert all(weight.dtype == torch.float32 for weight in load_file(tmp_path / WEIGHTS).values())


def test_a_merged_lora_is_the_lora(renders, trained, views, tmp_path) -> None:
    fit_lora(trained / WEIGHTS, renders, tmp_path, 2, replace(SHORT, rate=2e-2))
    base = load_network(tmp_path / WEIGHTS)
    for weight, other in zip(base.parameters(), load_network(trained / WEIGHTS).parameters(), strict=True):
        assert torch.equal(weight, other)
    adapted = PeftModel.from_pretrained(load_network(tmp_path / WEIGHTS), str(tmp_path / LORA)).eval()
    merged = merge_lora(load_network(tmp_path / WEIGHTS), tmp_path / LORA)
    batch = next(iter(Batches(views, 4, seed=1)))
    given = {name: batch[name] for name in ("photo", "light", "mask", "mode")}
    given |= {"x": torch.zeros_like(batch["x0"]), "sigma": torch.ones(4)}
    with torch.no_grad():
        plain, unmerged, after = (network(**given) for network in (base, adapted, merged))
    torch.testing.assert_close(after, unmerged, rtol=0, atol=1e-5)
    assert (after - plain).abs().max() > 1e-4


def test_the_rate_warms_up_stays_and_falls_to_nothing() -> None:
    plan = Plan(steps=1000, rate=1.0, warmup=100)
    rates = [plan.rate_at(step) for step in range(1001)]
    assert rates[0] == pytest.approx(0.01) and rates[1000] == 0
    assert rates[:100] == sorted(rates[:100]) and rates[99:801] == [1.0] * 702
    assert rates[800:] == sorted(rates[800:], reverse=True)
    longer = Plan(steps=2000, rate=1.0, warmup=100)
    assert [longer.rate_at(step) for step in range(801)] == rates[:801]


def test_flow_times_are_one_or_shifted_towards_it() -> None:
    generator = torch.Generator().manual_seed(0)
    sigma = draw_sigma(20_000, Plan(steps=1, shift=8.0, always_noise=0.5), generator)
    below = sigma[sigma < 1]
    assert sigma.min() >= 0.02 and sigma.max() == 1
    assert len(below) / len(sigma) == pytest.approx(0.5, abs=0.02)
    assert float(below.median()) == pytest.approx(8 * 0.5 / (1 + 7 * 0.5), abs=0.01)


def test_the_photos_own_light_is_learnt_from_every_sample(views) -> None:
    torch.manual_seed(0)
    batch, network = next(iter(Batches(views, 8, seed=3))), Mini(TINY)
    noise, sigma = torch.randn_like(batch["x0"]), torch.ones(8)
    without = {name: value for name, value in batch.items() if name != "own"}
    plain, whole = (flow_loss(network, each, sigma, noise, source_weight=0.5) for each in (without, batch))
    _, light = network(
        noise, sigma, batch["photo"], batch["light"], batch["mask"], batch["mode"], with_source=True
    )
    error = (2 * light - 1 - batch["own"]).square().mean()
    torch.testing.assert_close(whole, plain + 0.5 * error)
    estimates = batch["mode"] == 1
    assert torch.equal(batch["own"][estimates], batch["x0"][estimates])


@pytest.mark.slow
def test_compiled_training_is_training(renders, tmp_path) -> None:
    for name, compiled in (("plain", False), ("compiled", True)):
        fit(renders, tmp_path / name, TINY, replace(SHORT, steps=2, compiled=compiled))
    plain, compiled = (load_file(tmp_path / name / WEIGHTS) for name in ("plain", "compiled"))
    for key, weight in plain.items():
        torch.testing.assert_close(compiled[key], weight, rtol=1e-3, atol=1e-5)


def off_by(error: torch.Tensor) -> torch.nn.Module:
    """A network whose answer is wrong by `error`, at sigma = 1 and without noise."""

    class Off(torch.nn.Module):
        def forward(self, x, sigma, photo, light, mask, mode):
            return -(error + 0 * photo)

    return Off()


@pytest.mark.parametrize("weight", [1.0, 4.0])
def test_an_error_under_strokes_counts_more_and_the_weights_are_1_in_the_mean(weight):
    mask = torch.zeros(1, 1, 8, 8)
    mask[..., :2, :] = 1  # a quarter of the cells
    blank = torch.zeros(1, 3, 8, 8)
    batch = {"photo": blank, "light": blank, "mask": mask, "mode": torch.zeros(1, dtype=torch.int64)}
    batch["x0"] = blank

    def loss(error):
        return float(flow_loss(off_by(error), batch, torch.ones(1), blank, drawn=weight))

    assert loss(torch.ones(1, 3, 8, 8)) == pytest.approx(1)
    assert loss(mask) / loss(1 - mask) == pytest.approx((1 + weight) / 3)


def test_errors_that_change_from_cell_to_cell_count_more_than_even_ones():
    blank = torch.zeros(1, 3, 8, 8)
    batch = {"photo": blank, "light": blank, "mask": blank[:, :1], "mode": torch.zeros(1, dtype=torch.int64)}
    batch["x0"] = blank
    rows, columns = torch.meshgrid(torch.arange(8), torch.arange(8), indexing="ij")
    checks = (1.0 - 2 * ((rows + columns) % 2)).expand(1, 3, 8, 8)

    def loss(error):
        return float(flow_loss(off_by(error), batch, torch.ones(1), blank, edges=0.5))

    assert loss(torch.ones(1, 3, 8, 8)) == pytest.approx(1)
    assert loss(checks) == pytest.approx(1 + 0.5 * (4 + 4))


def test_training_goes_on_from_weights_with_their_sizes(tmp_path, renders):
    config = Config(width=16, depth=1, heads=1, patch=4, fine=4, half=8, quarter=8)
    save_network(Mini(config), tmp_path / "start.safetensors")
    plan = Plan(1, batch=2, rate=0.0, grids=((16, 16),))
    fit(renders, tmp_path / "out", tmp_path / "start.safetensors", plan)
    start, end = (load_network(tmp_path / name) for name in ("start.safetensors", "out/model.safetensors"))
    assert end.config == config
    for (name, weight), other in zip(start.named_parameters(), end.parameters(), strict=True):
        torch.testing.assert_close(other, weight, atol=1e-6, rtol=0, msg=name)


class Brush(torch.nn.Module):
    """Light under a stroke follows what is drawn to a power, and burns out at white."""

    def __init__(self, power: float) -> None:
        super().__init__()
        self.power = torch.nn.Parameter(torch.tensor(power))

    def forward(self, x, sigma, photo, light, mask, mode, own=None, with_source=False):
        linear = srgb_to_linear(photo)
        ratio = self.power * torch.log((light + BOUNCED) / (0.25 + BOUNCED)) * mask
        relit = ((linear + FLOOR) * torch.exp(ratio) - FLOOR).clamp(0, 1)
        velocity = RELIT_SCALE * (photo - linear_to_srgb(relit))
        return (velocity, torch.full_like(photo, 0.25)) if with_source else velocity


@pytest.mark.parametrize("power", [1.0, 0.5])
def test_light_has_to_follow_the_value_drawn(power):
    photo = torch.full((4, 3, 8, 8), 0.5)
    mask = torch.zeros(4, 1, 8, 8)
    mask[..., 3:5, 3:5] = 1
    batch = {"photo": photo, "light": 0.2 * mask.expand(4, 3, 8, 8), "mask": mask}
    batch["mode"] = torch.zeros(4, dtype=torch.int64)
    brush, factor = Brush(power), torch.tensor([0.25, 0.5, 1.0, 2.0])
    loss = response_loss(brush, batch, factor)
    told = torch.log((0.2 * factor + BOUNCED) / (0.2 + BOUNCED))
    torch.testing.assert_close(loss, ((1 - power) * told).square().mean(), atol=1e-4, rtol=1e-3)
    loss.backward()
    assert power == 1.0 or brush.power.grad < -0.1, "what follows too little is to follow more"
    burnt = response_loss(Brush(1.0), {**batch, "light": 40 * batch["light"]}, factor)
    assert float(burnt.detach()) == 0, "of what is burnt out nothing is asked"
