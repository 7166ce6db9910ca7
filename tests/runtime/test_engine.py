"""The engine: its door, its self-test, its threads, its errors."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper

from dior_rt import providers
from dior_rt.bundle import Bundle, read_bundle, write_bundle
from dior_rt.engine import Engine, open_engine
from dior_rt.errors import BundleError, DeviceError, InputError
from dior_rt.providers import PROVIDERS, available


def write_graph(path, nodes, inputs, outputs):
    """A graph of a few nodes; tensors are (name, type, shape)."""
    values = [[helper.make_tensor_value_info(*tensor) for tensor in tensors] for tensors in (inputs, outputs)]
    model = helper.make_model(
        helper.make_graph(nodes, "test", *values), opset_imports=[helper.make_opsetid("", 20)], ir_version=9
    )
    onnx.save(model, path)
    return path


@pytest.fixture
def scaled_sum(tmp_path):
    """y = k x + z, of free rows by 3."""
    return write_graph(
        tmp_path / "graph.onnx",
        [helper.make_node("Mul", ["x", "k"], ["kx"]), helper.make_node("Add", ["kx", "z"], ["y"])],
        [
            ("x", TensorProto.FLOAT, ["rows", 3]),
            ("k", TensorProto.FLOAT, [1]),
            ("z", TensorProto.FLOAT, ["rows", 3]),
        ],
        [("y", TensorProto.FLOAT, ["rows", 3])],
    )


def feeds(rows=2, seed=0):
    rng = np.random.default_rng(seed)
    x, z = rng.random((2, rows, 3), dtype=np.float32)
    return {"x": x, "k": np.float32([2]), "z": z}


def test_runs_a_graph(scaled_sum):
    given = feeds()
    got = Engine(scaled_sum).run(given)
    assert list(got) == ["y"]
    np.testing.assert_allclose(got["y"], 2 * given["x"] + given["z"], rtol=1e-6)


def test_arrays_that_are_not_contiguous_are_read_right(scaled_sum):
    given = feeds()
    given["x"] = np.asfortranarray(given["x"])
    given["z"] = given["z"][::-1]
    np.testing.assert_allclose(Engine(scaled_sum).run(given)["y"], 2 * given["x"] + given["z"], rtol=1e-6)


def test_constants_stay_bound_and_results_are_the_callers_own(scaled_sum):
    given = feeds()
    binding = Engine(scaled_sum).bind({"k": given["k"], "z": given["z"]})
    first = binding.run({"x": given["x"]})["y"]
    kept = first.copy()
    second = binding.run({"x": given["x"] + 1})["y"]
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_allclose(second, first + 2, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"x": np.zeros((2, 3))}, "'x' expects float32 rows x 3 and got float64 2 x 3"),
        ({"x": np.zeros((2, 4), np.float32)}, "'x' expects float32 rows x 3 and got float32 2 x 4"),
        ({"x": np.zeros(3, np.float32)}, "'x' expects float32 rows x 3 and got float32 3"),
        ({"z": np.zeros((5, 3), np.float32)}, "'z' expects float32 2 x 3 and got float32 5 x 3"),
        ({"x": np.zeros((0, 3), np.float32), "z": np.zeros((0, 3), np.float32)}, "got float32 0 x 3"),
        ({"w": np.zeros(1, np.float32)}, "expects ['k', 'x', 'z'] and got ['k', 'w', 'x', 'z']"),
    ],
)
def test_the_door_names_what_was_expected_and_got(scaled_sum, change, says):
    with pytest.raises(InputError) as refusal:
        Engine(scaled_sum).run({**feeds(), **change})
    assert says in str(refusal.value)


def test_a_missing_input_is_refused(scaled_sum):
    given = feeds()
    del given["k"]
    with pytest.raises(InputError, match="got"):
        Engine(scaled_sum).run(given)


def test_sides_must_be_multiples_where_the_graph_says_so(mini_bundle):
    engine = open_engine(read_bundle(mini_bundle), "velocity", "cpu")
    with np.load(mini_bundle / "velocity.npz") as probe:
        given = {tensor.name: probe[tensor.name] for tensor in engine.inputs}
    cut = {name: array[..., :-1] if array.ndim == 4 else array for name, array in given.items()}
    with pytest.raises(InputError, match=r"\d\*columns"):
        engine.run(cut)


def test_results_that_are_no_numbers_are_an_error(scaled_sum):
    given = feeds()
    given["x"][0, 0] = np.nan
    with pytest.raises(DeviceError, match="not finite"):
        Engine(scaled_sum).run(given)


def test_errors_of_the_runtime_become_one_sentence(tmp_path):
    path = write_graph(
        tmp_path / "gather.onnx",
        [helper.make_node("Gather", ["x", "i"], ["y"])],
        [("x", TensorProto.FLOAT, [3]), ("i", TensorProto.INT64, [1])],
        [("y", TensorProto.FLOAT, [1])],
    )
    with pytest.raises(DeviceError) as failure:
        Engine(path).run({"x": np.zeros(3, np.float32), "i": np.array([7])})
    assert str(failure.value).startswith("cpu failed") and "\n" not in str(failure.value)


@pytest.mark.parametrize("content", [b"", b"no graph", b"\x08" * 1000])
def test_a_file_that_is_no_graph_is_refused(tmp_path, content):
    path = tmp_path / "broken.onnx"
    path.write_bytes(content)
    with pytest.raises(BundleError):
        Engine(path)


@pytest.mark.parametrize("device", ["gpu", "", "cuda:x", "cpu:1", "CPUExecutionProvider"])
def test_an_unknown_device_is_refused(scaled_sum, device):
    with pytest.raises(DeviceError, match="cpu, or auto"):
        Engine(scaled_sum, device)


@pytest.mark.parametrize("threads", [0, -2])
def test_a_thread_count_below_one_is_refused(scaled_sum, threads):
    with pytest.raises(InputError, match="threads"):
        Engine(scaled_sum, threads=threads)


def test_threads_do_not_change_the_result(mini_bundle):
    bundle = read_bundle(mini_bundle)
    one, two = (open_engine(bundle, "velocity", "cpu", threads=n) for n in (1, 2))
    with np.load(mini_bundle / "velocity.npz") as probe:
        given = {tensor.name: probe[tensor.name] for tensor in one.inputs}
    np.testing.assert_allclose(one.run(given)["velocity"], two.run(given)["velocity"], rtol=1e-4, atol=1e-4)


def test_one_engine_serves_many_threads(scaled_sum):
    engine = Engine(scaled_sum)
    cases = [feeds(rows=1 + i % 7, seed=i) for i in range(64)]
    with ThreadPoolExecutor(8) as pool:
        results = list(pool.map(lambda case: engine.run(case)["y"], cases))
    for case, result in zip(cases, results, strict=True):
        np.testing.assert_allclose(result, 2 * case["x"] + case["z"], rtol=1e-6)


def test_auto_says_why_it_took_the_cpu(mini_bundle, monkeypatch):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    engine = open_engine(read_bundle(mini_bundle), "velocity")
    assert engine.device == "cpu"
    assert "no accelerator" in engine.reason


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_auto_passes_over_an_accelerator_that_cannot_start(mini_bundle, monkeypatch):
    # This installation has no such provider: ONNX Runtime itself refuses it when the session is made.
    built = onnxruntime.get_available_providers()
    missing = next(name for name, provider in PROVIDERS.items() if provider.ort_name not in built)
    monkeypatch.setattr(providers, "available", lambda: [missing, "cpu"])
    monkeypatch.setattr(providers, "is_built_in", lambda name: True)
    engine = open_engine(read_bundle(mini_bundle), "velocity")
    assert engine.device == "cpu"
    assert missing in engine.reason
    with pytest.raises(DeviceError, match=missing):
        open_engine(read_bundle(mini_bundle), "velocity", missing)


def altered(bundle: Bundle, files: dict[str, Path], folder: Path) -> Bundle:
    """The bundle with other files in the place of some."""
    own = {name: bundle.folder / name for name in bundle.manifest.files}
    return write_bundle(folder, bundle.manifest, own | files)


def test_a_device_that_computes_something_else_is_refused(mini_bundle, tmp_path):
    bundle = read_bundle(mini_bundle)
    with np.load(mini_bundle / "velocity.npz") as probe:
        arrays = dict(probe)
    arrays["velocity"] = arrays["velocity"] * 1.01
    np.savez(tmp_path / "velocity.npz", **arrays)
    wrong = altered(bundle, {"velocity.npz": tmp_path / "velocity.npz"}, tmp_path / "wrong")
    for device in ("cpu", "auto"):
        with pytest.raises(DeviceError, match="wrong results"):
            open_engine(wrong, "velocity", device)


def test_a_graph_with_other_tensors_than_promised_is_refused(mini_bundle, tmp_path, scaled_sum):
    other = altered(read_bundle(mini_bundle), {"velocity.onnx": scaled_sum}, tmp_path / "other")
    with pytest.raises(BundleError, match="other tensors"):
        open_engine(other, "velocity", "cpu")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", "lacks"])
def test_a_probe_that_cannot_be_read_is_refused(mini_bundle, tmp_path, content):
    probe = tmp_path / "velocity.npz"
    if content == "lacks":
        np.savez(probe, x=np.zeros(1))
    else:
        probe.write_bytes(content)
    bad = altered(read_bundle(mini_bundle), {"velocity.npz": probe}, tmp_path / "bad")
    with pytest.raises(BundleError, match="self-test"):
        open_engine(bad, "velocity", "cpu")


@pytest.mark.parametrize("device", available())
def test_every_device_here_passes_its_self_test(mini_bundle, device):
    engine = open_engine(read_bundle(mini_bundle), "velocity", device)
    assert engine.device == device and engine.reason


def test_the_cpu_is_always_there_and_last():
    assert available()[-1] == "cpu"
