"""The export of mini: a portable graph that computes what torch computes, or nothing at all."""

import copy
import dataclasses
import json
import shutil

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from peft import LoraConfig, get_peft_model
from safetensors.torch import save_file

from dior_rt.bundle import read_bundle
from dior_rt.cli import run as run_command
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError, InputError
from dior_rt.export import mini as export
from dior_rt.export.check import (
    ExportError,
    check_evaluations,
    check_sampling,
    evaluate,
    random_feeds,
    relative_error,
    run,
)
from dior_rt.export.mini import (
    EXACT,
    Encode,
    Step,
    answers,
    export_checkpoint,
    export_network,
    open_checked,
    round_to_half,
    store_as_half,
)
from dior_rt.families import mini
from dior_rt.flow.schedule import ShiftSchedule
from dior_rt.training.network import Mini, save_network


@pytest.fixture(scope="module", params=["encode", "velocity"])
def graph(request, exported):
    return onnx.load(exported.path(request.param))


def open_graphs(bundle, threads=None) -> mini.Graphs:
    return mini.Graphs(*(open_engine(bundle, name, "cpu", threads) for name in ("encode", "velocity")))


@pytest.fixture
def rounded(network, recipe):
    """The network as `exported` holds it."""
    round_to_half(network, recipe.grid)
    return network


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
    feeds = {name: array[:batch] for name, array in random_feeds(*size, seed=9).items()}
    assert relative_error(run(open_graphs(exported), feeds), evaluate(rounded, feeds)) < 1e-5


@pytest.mark.parametrize("size", [(56, 80), (36, 100)])
def test_neither_threads_nor_the_batch_change_a_bit(exported, size):
    feeds = random_feeds(*size, seed=4)
    one = {name: array[3:4] for name, array in feeds.items()}
    alone, batch = (run(open_graphs(exported, 1), given) for given in (one, feeds))
    for threads in (2, 3):
        graphs = open_graphs(exported, threads)
        np.testing.assert_array_equal(run(graphs, one), alone)
        np.testing.assert_array_equal(run(graphs, feeds), batch)
    np.testing.assert_array_equal(batch[3:4], alone)


def test_what_does_not_depend_on_the_flow_is_no_part_of_a_step(exported):
    taken = {name: {t.name for t in graph.inputs} for name, graph in exported.manifest.graphs.items()}
    assert taken["encode"] == {*mini.SEEN, "own"}
    assert taken["velocity"].isdisjoint(mini.SEEN) and {"x", "sigma"} < taken["velocity"]


def test_the_graph_is_portable_and_says_nothing_of_where_it_was_made(graph):
    assert {opset.domain for opset in graph.opset_import} == {""}
    assert {node.domain for node in graph.graph.node} == {""}
    assert not graph.functions
    text = graph.SerializeToString()
    assert b".py" not in text and b"site-packages" not in text


def test_weights_are_stored_in_half_the_space(exported, network):
    graphs = [onnx.load(exported.path(name)).graph for name in exported.manifest.graphs]
    stored = sum(len(tensor.raw_data) for graph in graphs for tensor in graph.initializer)
    assert stored < 0.6 * sum(weight.numel() * 4 for weight in network.parameters())


@pytest.mark.parametrize("fits", [True, False])
def test_weights_become_half_only_where_that_changes_no_result(tmp_path, fits):
    rng = np.random.default_rng(0)
    large, small = (
        rng.standard_normal((64, 32)).astype(np.float32),
        rng.standard_normal(32).astype(np.float32),
    )
    if fits:
        large = large.astype(np.float16).astype(np.float32)
    path = tmp_path / "graph.onnx"
    nodes = [
        helper.make_node("MatMul", ["x", "large"], ["m"]),
        helper.make_node("Add", ["m", "small"], ["y"]),
    ]
    ends = [
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", width])]
        for name, width in (("x", 64), ("y", 32))
    ]
    weights = [numpy_helper.from_array(large, "large"), numpy_helper.from_array(small, "small")]
    graph = helper.make_graph(nodes, "test", *ends, weights)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9), path)
    feeds = {"x": rng.standard_normal((5, 64)).astype(np.float32)}
    before = Engine(path).run(feeds)["y"]

    store_as_half(path)
    onnx.checker.check_model(path, full_check=True)
    kinds = [tensor.data_type for tensor in onnx.load(path).graph.initializer]
    assert kinds == [TensorProto.FLOAT16 if fits else TensorProto.FLOAT, TensorProto.FLOAT]
    np.testing.assert_array_equal(Engine(path).run(feeds)["y"], before)


def test_rounding_to_half_reports_its_cost(network, recipe):
    before = copy.deepcopy(network)
    cost = round_to_half(network, recipe.grid)
    feeds = random_feeds(*recipe.grid.shape(1, 1), seed=0)
    assert cost == pytest.approx(relative_error(evaluate(network, feeds), evaluate(before, feeds)))
    assert round_to_half(network, recipe.grid) == 0


@pytest.mark.parametrize("name, part", [("encode", Encode), ("velocity", Step)])
def test_the_probe_is_what_torch_answers(exported, rounded, name, part):
    graph = exported.manifest.graphs[name]
    with np.load(exported.folder / graph.probe, allow_pickle=False) as probe:
        arrays = dict(probe)
    found = answers(part(rounded), {tensor.name: arrays.pop(tensor.name) for tensor in graph.inputs})
    assert found.keys() == arrays.keys() == {tensor.name for tensor in graph.outputs}
    for output, array in found.items():
        np.testing.assert_allclose(array, arrays[output], rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_a_checkpoint_with_a_lora_becomes_a_bundle(network, recipe, tmp_path):
    save_network(network, tmp_path / "model.safetensors")
    torch.manual_seed(1)
    adapted = get_peft_model(network, LoraConfig(r=2, target_modules=["qkv"], init_lora_weights=False))
    adapted.save_pretrained(tmp_path / "lora")
    bundle = export_checkpoint(tmp_path, tmp_path / "b", config=recipe, weights="fp32")
    assert bundle.manifest.precision == "fp32" and "weights_as_fp16" not in bundle.manifest.parity
    assert bundle.manifest.grid == dataclasses.replace(recipe.grid, multiple=network.config.patch)
    feeds = random_feeds(8, 12, seed=3)
    assert relative_error(run(open_graphs(bundle), feeds), evaluate(adapted.eval(), feeds)) < 1e-5


@pytest.mark.slow
def test_int8_multiplies_in_integers_and_stays_near(network, recipe, tmp_path):
    """Its self-test holds devices to the CPU's answers; its parity says how far those are from torch's."""
    bundle = export_network(network, recipe, tmp_path / "b", weights="int8")
    assert bundle.manifest.precision == "int8"
    assert 1e-5 < bundle.manifest.parity["evaluation"] < 0.2
    operators = {node.op_type for node in onnx.load(bundle.path("velocity")).graph.node}
    assert "MatMulInteger" in operators and "MatMul" in operators  # attention stays float32
    feeds = random_feeds(8, 12, seed=3)
    assert 1e-6 < relative_error(run(open_graphs(bundle), feeds), evaluate(network, feeds)) < 0.2


def test_the_command_says_how_the_bundle_runs(network, tmp_path, capfd):
    save_network(network, tmp_path / "model.safetensors")
    made = ["export", str(tmp_path), "--steps", "2", "-o", str(tmp_path / "b"), "--shift"]
    for shift in ("0", "-1", "nan", "1e9"):
        assert run_command([*made, shift]) == 2
        said = capfd.readouterr().err
        assert "shift must be a positive number" in said and said.count("\n") == 1
    assert not (tmp_path / "b").exists()
    assert run_command([*made, "3.5", "--guidance", "1.5", "--noise-scale", "0"]) == 0
    manifest = read_bundle(tmp_path / "b").manifest
    assert (manifest.schedule, manifest.steps) == (ShiftSchedule(3.5), 2)
    assert (manifest.guidance, manifest.noise_scale) == (1.5, 0)


def spoiled(network, by):
    """The same network with one weight changed."""
    other = copy.deepcopy(network)
    with torch.no_grad():
        other.head.weight *= 1 + by
    return other


def test_a_graph_that_differs_fails_in_one_evaluation(exported, rounded, recipe):
    graphs = open_graphs(exported)
    assert check_evaluations(rounded, graphs, recipe.grid, EXACT) < 1e-5
    with pytest.raises(ExportError, match="off by"):
        check_evaluations(spoiled(rounded, by=0.01), graphs, recipe.grid, EXACT)


def test_a_graph_that_differs_fails_after_all_steps(exported, rounded, recipe):
    graphs, sigmas = open_graphs(exported), ShiftSchedule(8.0).sigmas(4)
    assert check_sampling(rounded, graphs, recipe.grid, sigmas, 2.0, EXACT) > 100
    with pytest.raises(ExportError, match="dB"):
        check_sampling(spoiled(rounded, by=0.2), graphs, recipe.grid, sigmas, 2.0, EXACT)


@pytest.mark.slow
def test_an_export_over_the_bar_leaves_nothing_behind(exported, network, recipe, tmp_path, monkeypatch):
    # The graph of other weights stands in for one that was converted wrongly.
    monkeypatch.setattr(export, "convert", lambda _, path, __: shutil.copy(exported.folder / path.name, path))
    with pytest.raises(ExportError, match="off by"):
        export_network(spoiled(network, by=0.01), recipe, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


def test_broken_weights_are_refused(network, recipe, tmp_path):
    with torch.no_grad():
        network.unembed.weight[0, 0] = torch.nan
    with pytest.raises(ExportError, match="no number"):
        export_network(network, recipe, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("damage", ["missing", "cut", "no config", "other config", "other weights", "pickle"])
def test_what_is_no_checkpoint_is_refused(network, tmp_path, damage):
    path = tmp_path / "model.safetensors"
    save_network(network, path)
    config = {"config": json.dumps(dataclasses.asdict(network.config))}
    weights = dict(network.state_dict())
    match damage:
        case "missing":
            path.unlink()
        case "cut":
            path.write_bytes(path.read_bytes()[:-4])
        case "no config":
            save_file(weights, path)
        case "other config":
            save_file(weights, path, metadata={"config": '{"wide": 3}'})
        case "other weights":
            save_file({name: weights[name] for name in list(weights)[1:]}, path, metadata=config)
        case "pickle":
            torch.save(weights, path)
    with pytest.raises(InputError) as refusal:
        export_checkpoint(path, tmp_path / "b")
    assert "\n" not in str(refusal.value)
    assert not (tmp_path / "b").exists()


def test_a_network_that_is_no_graph_is_refused(network, recipe, tmp_path):
    class Undecided(Mini):
        def step(self, x, *rest):
            return x if float(x.sum()) > 0 else -x

    with pytest.raises(ExportError, match="ONNX"):
        export_network(Undecided(network.config), recipe, tmp_path / "b")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("change", [{"steps": 0}, {"guidance": -1.0}, {"noise_scale": float("nan")}])
def test_a_recipe_that_cannot_be_is_refused_before_any_work(network, recipe, tmp_path, monkeypatch, change):
    monkeypatch.setattr(export, "convert", lambda *_: pytest.fail("it went to work"))
    with pytest.raises(InputError, match=next(iter(change))):
        export_network(network, dataclasses.replace(recipe, **change), tmp_path / "b")


def test_a_graph_that_is_no_onnx_is_refused(exported, tmp_path):
    model = onnx.load(exported.path("velocity"))
    model.graph.node[0].op_type = "Unheard"
    onnx.save(model, tmp_path / "model.onnx")
    with pytest.raises(ExportError, match="not valid ONNX"):
        open_checked(tmp_path / "model.onnx")


def test_a_bundle_in_the_way_is_found_before_any_work(network, recipe, tmp_path, monkeypatch):
    (tmp_path / "b").mkdir()
    monkeypatch.setattr(export, "convert", lambda *_: pytest.fail("it went to work"))
    with pytest.raises(BundleError, match="there already"):
        export_network(network, recipe, tmp_path / "b")


@pytest.mark.slow
def test_exporting_again_gives_the_same_bytes(exported, network, recipe, tmp_path):
    assert export_network(network, recipe, tmp_path / "b").manifest == exported.manifest
