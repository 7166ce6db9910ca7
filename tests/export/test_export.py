"""The export of mini: a portable graph that computes what torch computes, or nothing at all."""

import copy

import numpy as np
import onnx
import pytest
import torch
from dior_rt.export import check
from dior_rt.export.check import ExportError, check_evaluations, check_sampling, evaluate, random_feeds
from dior_rt.export.mini import convert, export_network, round_to_half, store_as_half

from dior_rt.bundle import read_bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError
from dior_rt.family import mini
from dior_rt.schedule import ShiftSchedule


@pytest.fixture(scope="module")
def exported(mini_bundle):
    return read_bundle(mini_bundle)


@pytest.fixture(scope="module")
def graph(mini_bundle):
    return onnx.load(mini_bundle / "model.onnx")


@pytest.fixture
def rounded(network, recipe):
    """The network as `mini_bundle` holds it."""
    round_to_half(network, recipe.grid)
    return network


def relative(got, want):
    return np.abs(got - want).max() / np.abs(want).max()


def test_the_manifest_says_how_to_run_it_and_how_well_it_was_met(exported, recipe):
    manifest = exported.manifest
    for name in ("name", "grid", "schedule", "steps", "guidance", "noise_scale"):
        assert getattr(manifest, name) == getattr(recipe, name)
    assert manifest.family == "mini" and manifest.precision == "fp16" and manifest.licence
    assert 0 < manifest.parity["evaluation"] <= 1e-4
    assert 60 <= manifest.parity["sampling_db"] < 200
    assert 0 < manifest.parity["weights_as_fp16"] < 1e-2


@pytest.mark.parametrize("size", [(4, 4), (4, 8), (64, 64), (52, 80), (4, 256), (256, 4)])
@pytest.mark.parametrize("batch", [1, 2, 10])
def test_every_size_and_batch_agrees_with_torch(exported, rounded, size, batch):
    engine = open_engine(exported, "velocity", "cpu")
    feeds = {name: array[:batch] for name, array in random_feeds(*size, seed=9).items()}
    assert relative(engine.run(feeds)["velocity"], evaluate(rounded, feeds)) < 1e-5


def test_the_graph_is_portable_and_says_nothing_of_where_it_was_made(graph):
    assert {opset.domain for opset in graph.opset_import} == {""}
    assert {node.domain for node in graph.graph.node} == {""}
    assert not graph.functions
    text = graph.SerializeToString()
    assert b".py" not in text and b"site-packages" not in text


def test_weights_are_stored_in_half_the_space(graph, network):
    stored = sum(len(tensor.raw_data) for tensor in graph.graph.initializer)
    assert stored < 0.6 * sum(weight.numel() * 4 for weight in network.parameters())


def test_storing_as_half_changes_no_result(rounded, recipe, tmp_path):
    path = tmp_path / "model.onnx"
    convert(rounded, path, recipe.grid.multiple)
    feeds = random_feeds(8, 12, seed=3)
    before = Engine(path).run(feeds)["velocity"]
    store_as_half(path)
    onnx.checker.check_model(path, full_check=True)
    np.testing.assert_array_equal(Engine(path).run(feeds)["velocity"], before)


def test_weights_that_half_would_change_stay_float32(network, recipe, tmp_path):
    path = tmp_path / "model.onnx"
    convert(network, path, recipe.grid.multiple)
    before = onnx.load(path)
    store_as_half(path)
    after = onnx.load(path)
    assert after.graph.node == before.graph.node
    assert after.graph.initializer == before.graph.initializer


def test_rounding_to_half_reports_its_cost(network, recipe):
    before = copy.deepcopy(network)
    cost = round_to_half(network, recipe.grid)
    feeds = random_feeds(*recipe.grid.shape(1, 1), seed=0)
    assert cost == pytest.approx(relative(evaluate(network, feeds), evaluate(before, feeds)))
    assert round_to_half(network, recipe.grid) == 0


def test_the_probe_is_what_torch_answers(exported, rounded):
    with np.load(exported.folder / "probe.npz", allow_pickle=False) as probe:
        arrays = dict(probe)
    np.testing.assert_allclose(
        evaluate(rounded, {k: arrays[k] for k in arrays if k != "velocity"}), arrays["velocity"]
    )


def test_float32_weights_can_be_kept(network, recipe, tmp_path):
    before = copy.deepcopy(network)
    bundle = export_network(network, recipe, tmp_path / "b", weights="fp32")
    assert bundle.manifest.precision == "fp32" and "weights_as_fp16" not in bundle.manifest.parity
    feeds = random_feeds(8, 12, seed=3)
    assert relative(Engine(bundle.path("velocity")).run(feeds)["velocity"], evaluate(before, feeds)) < 1e-5


def spoiled(network, by):
    """The same network with one weight changed."""
    other = copy.deepcopy(network)
    with torch.no_grad():
        other.head.weight[0] *= 1 + by
    return other


def test_a_graph_that_differs_fails_in_one_evaluation(exported, rounded):
    engine = open_engine(exported, "velocity", "cpu")
    assert check_evaluations(rounded, engine) < 1e-5
    with pytest.raises(ExportError, match="off by"):
        check_evaluations(spoiled(rounded, by=0.01), engine)


def test_a_graph_that_differs_fails_after_all_steps(exported, rounded):
    engine = open_engine(exported, "velocity", "cpu")
    bind, sigmas = (lambda condition: mini.bind(engine, condition)), ShiftSchedule(8.0).sigmas(4)
    assert check_sampling(rounded, bind, sigmas, 2.0) > 100
    with pytest.raises(ExportError, match="dB"):
        check_sampling(spoiled(rounded, by=0.2), bind, sigmas, 2.0)


def test_an_export_over_the_bar_leaves_nothing_behind(network, recipe, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "EVALUATION_BAR", 1e-12)
    with pytest.raises(ExportError):
        export_network(network, recipe, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_network_that_is_no_graph_is_refused(recipe, tmp_path):
    class Undecided(torch.nn.Module):
        def forward(self, x, sigma, photo, light, mask, mode):
            return x if float(x.sum()) > 0 else -x

    with pytest.raises(ExportError, match="ONNX"):
        export_network(Undecided(), recipe, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_bundle_in_the_way_is_found_before_any_work(network, recipe, tmp_path, monkeypatch):
    (tmp_path / "b").mkdir()
    monkeypatch.setattr("dior_rt.export.mini.convert", lambda *_: pytest.fail("it went to work"))
    with pytest.raises(BundleError, match="there already"):
        export_network(network, recipe, tmp_path / "b")


def test_exporting_again_gives_the_same_bytes(exported, network, recipe, tmp_path):
    assert export_network(network, recipe, tmp_path / "b").manifest == exported.manifest
