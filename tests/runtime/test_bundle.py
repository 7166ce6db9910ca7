"""The bundle: what is written is read back, and whatever is wrong is refused with a sentence."""

import dataclasses
import json
import shutil

import pytest

from dior_rt import bundle as bundles
from dior_rt.bundle import Graph, Manifest, Tensor, read_bundle, write_bundle
from dior_rt.errors import BundleError
from dior_rt.flow.schedule import DynamicShiftSchedule, ShiftSchedule
from dior_rt.grid import GridRule

MANIFEST = Manifest(
    family="mini",
    name="test",
    licence="Apache-2.0",
    precision="fp32",
    files={},
    graphs={"velocity": Graph("nets/model.onnx", (Tensor("x", "float32", ("batch", 3)),), (), "probe.npz")},
    schedule=ShiftSchedule(8.0),
    steps=40,
    guidance=1.5,
    grid=GridRule(4096, 4, 256),
    noise_scale=1.0,
    parity={"evaluation": 1e-7},
)


@pytest.fixture
def files(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    for name, content in (("model", b"weights" * 100), ("probe", b"probe")):
        (source / name).write_bytes(content)
    return {"nets/model.onnx": source / "model", "probe.npz": source / "probe"}


@pytest.fixture
def folder(tmp_path, files):
    write_bundle(tmp_path / "made" / "mini", MANIFEST, files)
    return tmp_path / "made" / "mini"


def edit(folder, change):
    path = folder / "manifest.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


@pytest.mark.parametrize(
    "manifest",
    [
        MANIFEST,
        dataclasses.replace(
            MANIFEST, family="qwen", schedule=DynamicShiftSchedule(0.5, 0.9, 256, 8192, 0.02), grid=None
        ),
    ],
)
def test_what_is_written_is_read_back(tmp_path, files, manifest):
    written = write_bundle(tmp_path / "b", manifest, files)
    assert read_bundle(tmp_path / "b") == written
    assert dataclasses.replace(written.manifest, files={}) == manifest
    assert written.path("velocity").read_bytes() == files["nets/model.onnx"].read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.update(format=3), "format 3, and this dior-rt reads 2: update"),
        (lambda d: d.update(format=1), "format 1, and this dior-rt reads 2: export its model again"),
        (lambda d: d.update(format="1"), "format"),
        (lambda d: d.update(family=7), "family"),
        (lambda d: d.update(surprise=1), "unknown key 'surprise'"),
        (lambda d: d.pop("steps"), "lacks the key 'steps'"),
        (lambda d: d.update(steps=0), "steps"),
        (lambda d: d.update(steps=True), "steps"),
        (lambda d: d.update(steps=4.0), "steps"),
        (lambda d: d.update(guidance="4"), "guidance"),
        (lambda d: d.update(guidance=-1), "guidance"),
        (lambda d: d.update(guidance=10**400), "too large"),
        (lambda d: d.update(noise_scale=None), "noise_scale"),
        (lambda d: d.update(schedule={"kind": "cosine"}), "schedule.kind"),
        (lambda d: d.update(schedule={"kind": "shift", "shift": 0}), "shift"),
        (lambda d: d.update(schedule={"kind": "shift", "shift": 1, "more": 1}), "unknown key 'more'"),
        (lambda d: d.update(schedule=[]), "schedule"),
        (lambda d: d["grid"].update(multiple=0), "grid"),
        (lambda d: d["graphs"]["velocity"].update(inputs=[{"name": "x"}]), "graphs.velocity.inputs[0]"),
        (lambda d: d.update(colour="linear"), "colour must be"),
        (lambda d: d.update(settings={"list": []}), "settings must be {}"),
        (lambda d: d["files"].pop("probe.npz"), "probe.npz"),
        (lambda d: d["files"].pop("nets/model.onnx"), "nets/model.onnx"),
        (lambda d: d["files"].update({"gone.bin": "0" * 64}), "lacks its file 'gone.bin'"),
        (lambda d: d["files"].update({"probe.npz": "0" * 64}), "was altered"),
        (lambda d: d["files"].update({"probe.npz": "short"}), "sha256"),
    ],
)
def test_a_manifest_that_is_not_right_is_refused(folder, change, says):
    edit(folder, change)
    with pytest.raises(BundleError) as refusal:
        read_bundle(folder)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "null",
        '{"format": 2, "format": 2}',
        '{"format": NaN}',
        "[" * 100_000,
        "\xff",
        " " * 2_000_000,
    ],
)
def test_a_manifest_that_is_no_json_is_refused(folder, text):
    (folder / "manifest.json").write_text(text, encoding="latin-1")
    with pytest.raises(BundleError) as refusal:
        read_bundle(folder)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "path",
    [
        "/etc/passwd",
        "../source/model",
        "nets/../../x",
        "C:\\x",
        "a\\b",
        "a:b",
        "./x",
        "",
        ".",
        "manifest.json",
        "a\0b",
    ],
)
def test_paths_that_leave_the_folder_are_refused(folder, files, tmp_path, path):
    edit(folder, lambda d: d["files"].update({path: "0" * 64}))
    with pytest.raises(BundleError):
        read_bundle(folder)
    with pytest.raises(BundleError):
        write_bundle(tmp_path / "new", MANIFEST, {**files, path: files["probe.npz"]})
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("what", ["file", "folder"])
def test_symbolic_links_out_of_the_folder_are_refused(folder, tmp_path, what):
    outside = tmp_path / "outside"
    shutil.move(folder / "nets", outside)
    if what == "folder":
        (folder / "nets").symlink_to(outside)
    else:
        (folder / "nets").mkdir()
        (folder / "nets" / "model.onnx").symlink_to(outside / "model.onnx")
    with pytest.raises(BundleError, match="outside"):
        read_bundle(folder)


def test_a_bundle_is_known_by_its_content(tmp_path, files):
    same = [write_bundle(tmp_path / name, MANIFEST, files).sha256 for name in "ab"]
    files["probe.npz"].write_bytes(b"other")
    other = write_bundle(tmp_path / "c", MANIFEST, files).sha256
    assert same[0] == same[1] != other


@pytest.mark.parametrize("damage", ["cut", "flip", "remove"])
def test_damaged_files_are_refused(folder, damage):
    path = folder / "nets" / "model.onnx"
    content = bytearray(path.read_bytes())
    path.unlink()
    if damage == "cut":
        path.write_bytes(content[:-1])
    elif damage == "flip":
        content[50] ^= 1
        path.write_bytes(content)
    with pytest.raises(BundleError, match=r"nets/model\.onnx"):
        read_bundle(folder)


def test_no_folder_and_no_manifest_are_refused(tmp_path):
    with pytest.raises(BundleError, match="no bundle at"):
        read_bundle(tmp_path / "nowhere")
    with pytest.raises(BundleError, match=r"no manifest\.json"):
        read_bundle(tmp_path)


def test_an_unknown_graph_is_refused(folder):
    with pytest.raises(BundleError, match="'decoder'"):
        read_bundle(folder).path("decoder")


def test_a_bundle_is_replaced_only_when_asked(folder, files):
    before = (folder / "manifest.json").read_bytes()
    with pytest.raises(BundleError, match="there already"):
        write_bundle(folder, MANIFEST, files)
    assert (folder / "manifest.json").read_bytes() == before
    write_bundle(folder, dataclasses.replace(MANIFEST, name="newer"), files, overwrite=True)
    assert read_bundle(folder).manifest.name == "newer"
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_without_an_atomic_exchange_a_bundle_is_replaced_too(folder, files, monkeypatch):
    monkeypatch.setattr(bundles, "_exchange", lambda a, b: False)
    write_bundle(folder, dataclasses.replace(MANIFEST, name="newer"), files, overwrite=True)
    assert read_bundle(folder).manifest.name == "newer"
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


@pytest.mark.parametrize("lack", ["the source", "the entry"])
def test_a_write_that_fails_leaves_the_old_bundle_and_nothing_else(folder, files, lack):
    broken = dict(files)
    if lack == "the source":
        broken["probe.npz"] = files["probe.npz"].with_name("missing")
    else:
        del broken["probe.npz"]
    with pytest.raises(BundleError):
        write_bundle(folder, MANIFEST, broken, overwrite=True)
    assert read_bundle(folder).manifest.name == "test"
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_what_is_no_bundle_is_never_overwritten(tmp_path, files):
    (tmp_path / "papers").mkdir()
    (tmp_path / "papers" / "thesis.txt").write_text("years of work")
    with pytest.raises(BundleError, match="no bundle"):
        write_bundle(tmp_path / "papers", MANIFEST, files, overwrite=True)
    assert (tmp_path / "papers" / "thesis.txt").read_text() == "years of work"


def test_a_place_that_cannot_be_written_is_refused(tmp_path, files):
    with pytest.raises(BundleError, match="Cannot write"):
        write_bundle(files["probe.npz"] / "b", MANIFEST, files)


def test_sources_are_left_as_they_were(tmp_path, files):
    before = {name: path.read_bytes() for name, path in files.items()}
    write_bundle(tmp_path / "b", MANIFEST, files)
    shutil.rmtree(tmp_path / "b")
    assert {name: path.read_bytes() for name, path in files.items()} == before
