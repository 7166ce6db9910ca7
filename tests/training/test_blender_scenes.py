"""The data renderer's parts that need no Blender: assets, scenes, files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from dior_rt.errors import InputError
from dior_rt.training.blender import meshes
from dior_rt.training.blender.assets import BENCH_PANORAMAS, Assets, Entry, load_model, save_model, split_of
from dior_rt.training.blender.collect import make_assets, write_entries
from dior_rt.training.blender.kinds import scene
from dior_rt.training.blender.lamps import reaches
from dior_rt.training.blender.meshes import Finish
from dior_rt.training.blender.probe import Hits
from dior_rt.training.blender.scene import Camera, Lamp, Thing
from dior_rt.training.blender.store import View, ViewHead, load_view, save_view
from dior_rt.training.blender.views import Job, numbers, reaches_enough, render_views

PLACES = ("floor", "small", "wall", "outdoor", "vehicle", "animal", "person")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A small asset folder: boxes in every place, random tiles, and grey panoramas."""
    out = tmp_path_factory.mktemp("assets")
    (out / "models").mkdir()
    (out / "surfaces").mkdir()
    (out / "panoramas").mkdir()
    entries = []
    for k in range(70):
        place = PLACES[k % len(PLACES)]
        size = (0.3, 0.2, 0.25) if place == "small" else (0.8, 0.6, 1.2)
        entry = Entry(f"models/box-{k}.npz", f"Box {k}", size, 0.0, size[2], place, "", "CC0 1.0")
        save_model(out / entry.file, meshes.box(size))
        entries.append(entry)
    write_entries(out, entries)
    noise = np.random.default_rng(0).integers(0, 255, (128, 4096, 3), dtype=np.uint8)
    Image.fromarray(noise).save(out / "surfaces" / "sheet00.webp")
    (out / "surfaces" / "kinds.json").write_text(json.dumps(["Wood", "Fabric", "Bricks", "Grass"] * 8))
    for name in (*BENCH_PANORAMAS, "city", "forest", "hall"):
        light = np.full((16, 32, 3), 0.5, np.float32)
        OpenEXR.File({}, {"RGB": light}).write(str(out / "panoramas" / f"{name}.exr"))
    return out


def test_a_split_depends_on_the_name_alone_and_holds_out_its_share():
    held = np.mean([split_of("model", f"models/{k}.npz") == "bench" for k in range(4000)])
    assert held == pytest.approx(0.12, abs=0.02)
    assert [split_of("panorama", name) for name in ("night", "city")] == ["bench", "train"]


def test_benchmark_scenes_share_no_asset_with_training(folder):
    assets = Assets.open(folder)
    for places in PLACES:
        train, bench = (set(assets.models(split, places)) for split in ("train", "bench"))
        assert not train & bench
    assert not set(assets.surfaces("train")) & set(assets.surfaces("bench"))
    assert {scene(k, assets, "bench").panorama.name for k in range(12)} <= set(BENCH_PANORAMAS)
    assert {scene(k, assets, "train").panorama.name for k in range(12)} <= {"city", "forest", "hall"}


def test_a_seed_gives_the_same_scene(folder):
    assets = Assets.open(folder)
    for seed in range(8):
        first, again, other = (scene(k, assets) for k in (seed, seed, seed + 100))
        assert first.cameras == again.cameras
        assert [thing.at for thing in first.things] == [thing.at for thing in again.things]
        assert first.cameras != other.cameras


def test_every_scene_has_one_subject_and_things_stand_above_the_ground(folder):
    assets = Assets.open(folder)
    for seed in range(30):
        described = scene(seed, assets)
        assert sum(thing.role == "subject" for thing in described.things) == 1
        for thing in described.things:
            if thing.role != "shell":
                assert thing.corners()[:, 2].min() > -0.01
                assert np.isfinite(thing.mesh.vertices).all()


def test_models_survive_saving(tmp_path):
    texture = np.arange(48, dtype=np.uint8).reshape(4, 4, 3)
    mesh = meshes.ball(0.5).finished(Finish(color=(0.1, 0.2, 0.3), texture=texture, glass=0.5))
    save_model(tmp_path / "ball.npz", mesh)
    read = load_model(tmp_path / "ball.npz")
    assert np.array_equal(read.vertices, mesh.vertices)
    assert np.array_equal(read.faces, mesh.faces)
    assert read.finishes == mesh.finishes
    assert np.array_equal(read.finishes[0].texture, texture)


def test_furniture_is_read_sized_and_its_missing_texture_replaced(tmp_path):
    source = tmp_path / "furniture" / "KatorLegaz"
    (source / "desk").mkdir(parents=True)
    (source / "PluginFurnitureCatalog.properties").write_text(
        "name#1=Desk\nmodel#1=/desk/desk.obj\nwidth#1=120\ndepth#1=60\nheight#1=75\ncategory#1=Office\n"
        "creator#1=A. Maker\ndoorOrWindow#1=false\n"
        "name#2=Screen door\nmodel#2=/desk/desk.obj\nwidth#2=120\ndepth#2=60\nheight#2=75\n"
    )
    (source / "desk" / "desk.mtl").write_text("newmtl wood\nKd 0.5 0.25 0.1\nmap_Kd gone.jpg\nd 0.4\n")
    (source / "desk" / "desk.obj").write_text(
        "mtllib desk.mtl\nusemtl wood\nv 0 0 0\nv 1 0 0\nv 1 2 0\nv 0 2 1\nvt 0 0\n"
        "f 1/1 2/1 3/1\nf -4/1 -2/1 -1/1\n"
    )
    data = tmp_path / "data"
    (data / "panoramas").mkdir(parents=True)
    (data / "surfaces").mkdir()
    (data / "surfaces" / "kinds.json").write_text("[]")
    entries = make_assets(tmp_path / "out", tmp_path / "furniture", data)
    assert [entry.name for entry in entries] == ["Desk"]
    mesh = Assets.open(tmp_path / "out").mesh(entries[0].file)
    assert np.allclose(mesh.size, [1.2, 0.6, 0.75], atol=1e-5)
    assert np.allclose(mesh.low, [-0.6, -0.3, 0], atol=1e-5)
    assert len(mesh.faces) == 2
    wood = mesh.finishes[1]
    assert wood.texture is None
    assert wood.color == pytest.approx([0.5**2.2, 0.25**2.2, 0.02])
    assert wood.glass == pytest.approx(0.6)
    assert "A. Maker" in (tmp_path / "out" / "ATTRIBUTION.md").read_text()


def test_a_folder_without_furniture_is_refused(tmp_path):
    with pytest.raises(InputError, match="no furniture"):
        make_assets(tmp_path / "out", tmp_path, tmp_path)
    assert not (tmp_path / "out").exists()


def view() -> View:
    rng = np.random.default_rng(0)
    h = w = 4

    def random(*shape: int) -> np.ndarray:
        return rng.random(shape).astype(np.float16)

    head = ViewHead(
        seed=1,
        view=0,
        scene_kind="room",
        split="train",
        panorama="city",
        lights=tuple({"kind": kind, "role": kind, "gobo": None} for kind in ("spot", "sun", "world")),
        roles=("shell", "subject"),
        camera={"at": [0.0, 0.0, 0.0], "fov": 40.0, "axes": np.eye(3).tolist()},
        renderer="test",
    )
    return View(
        images=random(3, h, w, 3),
        lumi=random(2, h, w),
        world_lumi=random(h, w, 3),
        normals=random(h, w, 3),
        depth=random(h, w),
        albedo=random(h, w, 3),
        sky=random(h, w),
        ids=np.ones((h, w), np.uint16),
        head=head,
    )


@pytest.mark.parametrize("with_world", [True, False])
def test_views_survive_saving(tmp_path, with_world):
    stored = view() if with_world else replace(view(), world_lumi=None, images=view().images[:2])
    save_view(tmp_path / "v.npz", stored)
    read = load_view(tmp_path / "v.npz")
    assert np.array_equal(read.images, stored.images)
    assert read.lumi_maps().shape == stored.images.shape
    assert np.array_equal(read.lumi_maps()[0, ..., 1], stored.lumi[0])
    assert read.head == stored.head


def test_a_view_that_is_cut_short_is_refused(tmp_path):
    path = tmp_path / "v.npz"
    save_view(path, view())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(InputError, match="no view that can be used"):
        load_view(path)


def test_shards_share_the_scenes_and_seeds_none(tmp_path):
    jobs = [Job(tmp_path, tmp_path, 7, seed, (k, 3)) for seed in (0, 1) for k in range(3)]
    found = [number for job in jobs for number in numbers(job)]
    assert len(found) == len(set(found)) == 14


def test_a_light_has_to_reach_a_twentieth_of_what_is_seen():
    seen = np.ones((20, 20), bool)
    lumi = np.zeros((20, 20, 3), np.float32)
    lumi[:1, :19] = 1
    assert not reaches_enough(lumi, seen)
    lumi[:1] = 1
    assert reaches_enough(lumi, seen)
    assert not reaches_enough(lumi, ~seen)


def test_the_probe_of_a_lamp_counts_what_it_shines_on():
    class Nothing:
        def cast(self, origin, directions, reach=1e6):
            none = np.zeros(len(directions), bool)
            return Hits(
                none, np.zeros((len(directions), 3)), np.zeros((len(directions), 3)), np.where(none, 0, -1)
            )

    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    at = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]])
    hits = Hits(np.ones(4, bool), at, up, np.zeros(4, int))
    cone = Lamp("spot", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 0.01, "test", cone=100.0)  # reaches 1.19 metres
    assert reaches(cone, Nothing(), hits) == 0.5
    assert reaches(replace(cone, kind="point"), Nothing(), hits) == 1.0
    assert reaches(replace(cone, at=(0.0, 0.0, -1.0)), Nothing(), hits) == 0.0


def test_a_camera_looks_along_its_middle_ray():
    camera = Camera((1.0, 2.0, 3.0), (1.0, 5.0, 3.0), 60.0)
    rays = camera.rays(3).reshape(3, 3, 3)
    assert np.allclose(rays[1, 1], [0, 1, 0])
    assert rays[0, 1, 2] > 0  # the first row is the upper one
    assert rays[1, 2, 0] > 0  # the last column is on the right


def test_a_thing_knows_what_lies_in_its_box():
    box = Thing(meshes.box((2, 1, 1)), (5.0, 0.0, 0.0), turn=np.pi / 2, scale=2.0)
    assert box.holds(np.array([5.0, 1.9, 1.0]), 0.0)
    assert not box.holds(np.array([6.9, 0.0, 1.0]), 0.0)
    assert box.holds(np.array([6.9, 0.0, 1.0]), 1.0)


def test_people_stand_on_the_ground_and_are_dressed(folder):
    pytest.importorskip("anny")
    from dior_rt.training.blender.people import make_person

    assets = Assets.open(folder)
    for seed in (0, 4):
        entry, mesh = make_person(seed, assets)
        again, same = make_person(seed, assets)
        assert entry == again and np.array_equal(mesh.vertices, same.vertices)
        assert mesh.low[2] == pytest.approx(0, abs=1e-5)
        assert 0.9 < mesh.size[2] < 2.1
        assert len(mesh.finishes) >= 6  # skin, clothes, shoes, eyes
        assert mesh.slots.max() < len(mesh.finishes)
        assert np.isfinite(mesh.vertices).all()


def test_views_are_rendered_once_and_the_same_again(folder, tmp_path):
    pytest.importorskip("bpy")
    from dior_rt.training.blender.cycles import ShootOptions

    options = ShootOptions(resolution=32, samples=4, lumi_samples=4)
    first, again = (Job(tmp_path / name, folder, 3, 0) for name in ("first", "again"))
    render_views(first, options)
    render_views(again, options)
    files = sorted(path.name for path in first.out.glob("*.npz"))
    assert files and files == sorted(path.name for path in again.out.glob("*.npz"))
    for name in files:
        one, other = load_view(first.out / name), load_view(again.out / name)
        assert np.array_equal(one.images, other.images)
        assert len(one.images) >= 3
        seen = one.sky < 0.5
        assert one.lumi_maps()[:, seen].astype(np.float32).mean((1, 2)) == pytest.approx(0.25, rel=0.01)
        assert not one.lumi_maps()[:, ~seen].any()
        assert np.isfinite(one.images).all()
    written = {path: path.stat().st_mtime_ns for path in first.out.iterdir()}
    render_views(first, options)
    assert written == {path: path.stat().st_mtime_ns for path in first.out.iterdir()}
