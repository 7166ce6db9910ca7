"""Mini's network: what it answers before it has learnt, what its output depends on, and its files."""

from itertools import pairwise

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from dior_rt.errors import InputError
from dior_rt.training import light as physics
from dior_rt.training.light import encode_lumi, srgb_to_linear
from dior_rt.training.network import (
    Config,
    Mini,
    features,
    load_network,
    model,
    rotate,
    rotations,
    save_network,
)

SMALL = Config(width=32, depth=1, heads=2, patch=4, fine=4, half=8, quarter=16)


def inputs(
    rows: int = 8, columns: int = 12, batch: int = 3, seed: int = 0, noise: bool = False
) -> dict[str, torch.Tensor]:
    """noise: whether x is nothing else, so that the answer is all the network's."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(channels: int) -> torch.Tensor:
        return torch.rand(batch, channels, rows, columns, generator=generator)

    return {
        "x": torch.randn(batch, 3, rows, columns, generator=generator),
        "sigma": torch.ones(batch) if noise else torch.tensor([1.0, 0.5, 0.01])[:batch],
        "photo": uniform(3),
        "light": 4 * uniform(3),
        "mask": uniform(1).round(),
        "mode": torch.zeros(batch, dtype=torch.int64),
    }


def found(network: Mini, given: dict[str, torch.Tensor]) -> torch.Tensor:
    """x0, the answer that the velocity points at."""
    return given["x"] - given["sigma"][:, None, None, None] * network(**given)


@pytest.fixture
def awake() -> Mini:
    """A small network all of whose weights take part."""
    torch.manual_seed(0)
    network = Mini(SMALL)
    with torch.no_grad():
        for weight in network.parameters():
            weight.normal_(std=0.2)
    return network.eval()


@torch.no_grad()
def test_untrained_it_returns_the_photo_if_nothing_is_drawn_and_takes_the_photo_for_light() -> None:
    network, given = Mini(SMALL), inputs(noise=True)
    np.testing.assert_allclose(found(network, {**given, "mask": 0 * given["mask"]}), 0, atol=1e-5)
    given["mode"] += 1
    expected = 2 * encode_lumi(srgb_to_linear(given["photo"])) - 1
    torch.testing.assert_close(found(network, given), expected, atol=1e-5, rtol=1e-5)


@torch.no_grad()
def test_untrained_it_already_follows_the_drawn_light() -> None:
    network, given = Mini(SMALL), inputs(noise=True)
    given["photo"], given["mask"] = 0.3 + 0 * given["photo"], 1 + 0 * given["mask"]
    given["light"] = 0.02 + 0.03 * given["light"]
    light = [given["light"], 2 * given["light"]]
    relit = [given["photo"] + found(network, {**given, "light": drawn}) / 4 for drawn in light]
    lit = [torch.log(srgb_to_linear(one) + physics.FLOOR) for one in relit]
    ratio = torch.log((light[1] + features.BOUNCED) / (light[0] + features.BOUNCED))
    torch.testing.assert_close(lit[1] - lit[0], ratio, atol=0.02, rtol=0.02)


def test_what_the_network_leaves_open_is_a_gaussian_about_what_it_expects() -> None:
    expected, noise = torch.randn(2, 1, 500, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    sigmas = torch.linspace(1, 0, 4001, dtype=torch.float64)
    x = noise
    for sigma, then in pairwise(sigmas):
        x = x + (then - sigma) * model.velocity(x, sigma, expected)
    torch.testing.assert_close(x, expected + model.DEVIATION * noise, atol=2e-3, rtol=0)
    assert model.velocity(noise, sigmas[-1], expected).isfinite().all(), "also where there is no noise left"


@torch.no_grad()
@pytest.mark.parametrize("size", [(4, 4), (4, 40), (12, 8), (32, 32)])
def test_any_grid_of_whole_patches_will_do(awake, size) -> None:
    velocity = awake(**inputs(*size))
    assert velocity.shape == (3, 3, *size) and velocity.isfinite().all()


@torch.no_grad()
def test_pictures_of_a_batch_do_not_mix(awake) -> None:
    given = inputs()
    given["mode"][1] = 1
    together = awake(**given)
    for k in range(3):
        alone = awake(**{name: value[k : k + 1] for name, value in given.items()})
        torch.testing.assert_close(together[k : k + 1], alone, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_every_input_matters_but_light_that_is_not_specified(awake) -> None:
    given = inputs()
    base = found(awake, given)
    for name, other in inputs(seed=1).items():
        if name in ("sigma", "mode"):
            other = 1 - given[name]
        changed = found(awake, {**given, name: other})
        assert (changed - base).abs().max() > 1e-3, name
    hidden = given["light"] + 5 * (1 - given["mask"])
    assert torch.equal(found(awake, {**given, "light": hidden}), base)


@torch.no_grad()
def test_the_photo_s_own_light_does_not_depend_on_strokes_state_or_time(awake) -> None:
    given, other = inputs(), inputs(seed=1)
    own = awake(**given, with_source=True)[1]
    for changed in ({**other, "photo": given["photo"]}, {**given, "light": 16 * given["light"]}):
        torch.testing.assert_close(awake(**changed, with_source=True)[1], own, atol=0, rtol=0)
    assert not torch.equal(awake(**other, with_source=True)[1], own)
    torch.testing.assert_close(awake(**given, own=own), awake(**given), atol=0, rtol=0)


@torch.no_grad()
def test_every_cell_sees_the_whole_grid(awake) -> None:
    given = inputs(16, 16, 1)
    moved = {**given, "photo": given["photo"].clone()}
    moved["photo"][..., :4, :4] = 0
    far = (found(awake, moved) - found(awake, given))[..., 12:, 12:]
    assert far.abs().max() > 1e-5


def test_positions_enter_attention_by_their_distance_alone() -> None:
    rows, columns, size = 6, 7, 16
    turns = rotations(rows, columns, size, torch.device("cpu"))
    q, k = torch.randn(2, 1, 1, 1, size, generator=torch.Generator().manual_seed(0))
    everywhere = [rotate(part.expand(1, 1, rows * columns, size), turns) for part in (q, k)]
    at = [part[0, 0].unflatten(0, (rows, columns)) for part in everywhere]
    pairs = [((0, 0), (2, 3)), ((3, 2), (5, 5)), ((1, 3), (3, 6))]
    products = [float(at[0][one] @ at[1][other]) for one, other in pairs]
    assert products == pytest.approx([products[0]] * 3, abs=1e-4)
    assert float(at[0][0, 0] @ at[1][3, 2]) != pytest.approx(products[0], abs=1e-3)


def test_relit_light_stays_physical(awake) -> None:
    given = inputs(noise=True)
    with torch.no_grad():
        awake.head.bias[:3] = 50.0
        bright = given["photo"] + found(awake, given) / 4
        awake.head.bias[:3] = -50.0
        dark = given["photo"] + found(awake, given) / 4
    assert bright.clamp(0, 1).min() > 0.99 and dark.clamp(0, 1).max() < 0.01
    black = torch.zeros(1, 3, 4, 4)
    assert (model.relit_answer(black, black, torch.ones(1, 3, 4, 4)) > 0.1).all(), "black can be lit"


def test_no_weave_is_left_and_what_is_even_stays() -> None:
    rows, columns = torch.meshgrid(torch.arange(16.0), torch.arange(24.0), indexing="ij")
    slope = (0.3 * rows + 0.1 * columns)[None, None]
    for weave in ((-1) ** rows, (-1) ** columns, (-1) ** (rows + columns)):
        mixed = features.mix_neighbours(slope + weave)
        torch.testing.assert_close(mixed[..., 1:-1, 1:-1], slope[..., 1:-1, 1:-1], atol=1e-5, rtol=0)
    one = torch.full((2, 3, 8, 12), 0.7)
    torch.testing.assert_close(features.mix_neighbours(one), one)


def test_what_is_drawn_is_spread_as_it_is_and_no_farther_than_said() -> None:
    drawn = torch.zeros(1, 4, 64, 64)
    drawn[..., 20:24, 20:24] = torch.tensor([2.0, -1.0, 0.0, 1.0])[:, None, None]
    near, everywhere = features.spread(drawn, 8), features.spread_everywhere(drawn)
    assert near[..., 52:].abs().max() < 0.02 and everywhere.std(dim=(2, 3)).max() == 0
    for *means, share in (near[0, :, 22, 22], everywhere[0, :, 0, 0]):
        assert 0.2 < share <= 1
        torch.testing.assert_close(torch.stack(means) / share, torch.tensor([2.0, -1.0, 0.0]))
    assert features.spread(0 * drawn, 8).abs().max() == 0


def test_what_is_drawn_is_spread_in_rounds_and_not_in_boxes() -> None:
    cells = torch.zeros(1, 1, 65, 65, dtype=torch.float64)
    cells[..., 32, 32] = 1
    mean = features.around(cells, 6)[0, 0]
    rows, columns = torch.meshgrid(torch.arange(65) - 32.0, torch.arange(65) - 32.0, indexing="ij")
    expected = torch.exp(-(rows**2 + columns**2) / 72).double() / (72 * torch.pi)
    torch.testing.assert_close(mean, expected, atol=1e-6, rtol=0)
    flat = features.around(torch.ones(1, 1, 5, 90), 6)
    torch.testing.assert_close(flat, torch.ones_like(flat))


@torch.no_grad()
def test_light_drawn_ends_softly_beside_a_stroke() -> None:
    given = inputs(64, 64, 1, noise=True)
    given["photo"], given["light"] = 0.3 + 0 * given["photo"], 0.3 + 0 * given["light"]
    given["mask"] = 0 * given["mask"]
    given["mask"][..., 20:44, 30:34] = 1
    relit = given["photo"] + found(Mini(SMALL), given) / 4
    row = torch.log(srgb_to_linear(relit[0, 0, 32]) + physics.FLOOR)
    row = (row - row[0]) / (row[31] - row[0])
    assert (row[31:33] - 1).abs().max() < 1e-3, "under the stroke it is what was drawn"
    assert (row[[30, 33]] - 1).abs().max() < 0.15, "and next to its edge nearly"
    falls = -row[32:].diff()
    assert 0 < falls[0] < 0.2 and falls.max() < 0.2 and falls.min() > -1e-4


def test_gradients_reach_every_weight_whatever_the_colour(awake) -> None:
    given = inputs()
    given["photo"][0], given["photo"][1] = 0, 1
    given["mode"][2] = 1
    awake(**given).square().mean().backward()
    for name, weight in awake.named_parameters():
        assert weight.grad is not None and weight.grad.isfinite().all() and weight.grad.any(), name


@torch.no_grad()
def test_a_network_survives_the_disk(awake, tmp_path) -> None:
    path = tmp_path / "model.safetensors"
    save_network(awake, path)
    back = load_network(path)
    assert back.config == SMALL and not back.training and [p.name for p in tmp_path.iterdir()] == [path.name]
    assert torch.equal(back(**inputs()), awake(**inputs()))


@torch.no_grad()
def test_half_precision_is_read_as_single(awake, tmp_path) -> None:
    path, half = tmp_path / "model.safetensors", tmp_path / "half.safetensors"
    save_network(awake, path)
    with safe_open(path, "pt") as file:
        header = file.metadata()
    save_file({name: weight.half() for name, weight in load_file(path).items()}, half, header)
    back = load_network(half)
    for (name, weight), other in zip(awake.named_parameters(), back.parameters(), strict=True):
        assert other.dtype == torch.float32 and torch.equal(other, weight.half().float()), name


def test_what_is_no_network_is_refused_in_a_sentence(awake, tmp_path) -> None:
    path = tmp_path / "model.safetensors"
    save_network(awake, path)
    whole, weights = path.read_bytes(), load_file(path)
    cases = {"cut": whole[: len(whole) // 2], "text": b"no network", "empty": b""}
    for name, content in cases.items():
        (tmp_path / name).write_bytes(content)
    save_file(weights, tmp_path / "bare")
    save_file(weights, tmp_path / "odd", {"config": '{"width": 32, "colour": 3}'})
    save_file(weights, tmp_path / "wider", {"config": '{"width": 64, "depth": 1, "heads": 2}'})
    for name in (*cases, "bare", "odd", "wider"):
        with pytest.raises(InputError, match="is no checkpoint of mini") as refusal:
            load_network(tmp_path / name)
        assert "\n" not in str(refusal.value)
    with pytest.raises(InputError, match="no such file"):
        load_network(tmp_path / "missing")


def test_a_width_that_the_heads_do_not_divide_is_refused() -> None:
    with pytest.raises(InputError, match="multiple of 4 times the heads"):
        Config(width=100, heads=8)
    with pytest.raises(InputError, match="patch must be a multiple of 4"):
        Config(patch=6)
