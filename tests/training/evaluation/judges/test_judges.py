"""Judges: known answers on synthetic models, and on the baselines; the marks; what cannot be judged."""

import json
from dataclasses import dataclass, replace

import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run as cli
from dior_rt.errors import InputError
from dior_rt.kernels import Strokes
from dior_rt.training.evaluation.judges import subjects as photos
from dior_rt.training.evaluation.judges.added import added
from dior_rt.training.evaluation.judges.changes import log_change, ratio_of_sums
from dior_rt.training.evaluation.judges.far import far
from dior_rt.training.evaluation.judges.form import blurred_share, form
from dior_rt.training.evaluation.judges.identity import identity
from dior_rt.training.evaluation.judges.material import material
from dior_rt.training.evaluation.judges.models import (
    ALL_BLENDS,
    SET_ONLY,
    Blur,
    Copy,
    Glow,
    as_set,
    blur_formula,
    drive,
    spread,
)
from dior_rt.training.evaluation.judges.objects import DABS, objects, usable
from dior_rt.training.evaluation.judges.panel import JUDGES, parse_judges
from dior_rt.training.evaluation.judges.ratio import ratio, ratio_strokes, real_pairs
from dior_rt.training.evaluation.judges.slope import slope
from dior_rt.training.evaluation.judges.subjects import (
    Marked,
    Subject,
    Triple,
    all_triples,
    find_photo,
    folder_photos,
    marked_photos,
)
from dior_rt.training.evaluation.metrics import psnr, scale_invariant_psnr
from dior_rt.training.evaluation.tasks import OPS

SIDE = 96
LIGHT = 0.25  # of the flat estimate


def two_fields() -> Subject:
    """A photo of an object, left, before a wall, right, both textured, and a triple across their border."""
    rng = np.random.default_rng(0)
    surface = rng.uniform(0.6, 1.0, (SIDE, SIDE, 3)).astype(np.float32)
    surface[:, : SIDE // 2] *= np.array([0.3, 0.2, 0.1], np.float32)
    surface[:, SIDE // 2 :] *= np.array([0.1, 0.2, 0.25], np.float32)
    triple = Triple("object, wall", (38.0, 48.0), (20.0, 48.0), (56.0, 48.0))
    marks = Marked("fields", (SIDE, SIDE), ((20.0, 20.0), (30.0, 70.0)), (triple,))
    return Subject("fields", OPS.encode_srgb(surface, np.uint8), marks)


SUBJECT = two_fields()


@dataclass(frozen=True)
class Exact:
    """Multiplies the photo's linear light by drawn light over LIGHT where `region` says: under the strokes,
    on the object, or everywhere."""

    name: str = "exact"
    blends: frozenset = ALL_BLENDS
    region: str = "strokes"

    def estimate(self, photo):
        return np.full((32, 32, 3), LIGHT, np.float32)

    def relight(self, photo, strokes, blend="set"):
        if strokes.mask.shape != photo.shape[:2]:
            strokes = resized(strokes, photo.shape[:2])
        light = {"set": strokes.light, "add": strokes.light + LIGHT, "multiply": strokes.light * LIGHT}[blend]
        drawn = strokes.mask > 0
        if self.region == "everywhere" and drawn.any():
            light, drawn = np.broadcast_to(light[drawn].mean(axis=0), light.shape), np.ones_like(drawn)
        if self.region == "object" and drawn.any():
            light = np.broadcast_to(light[drawn].mean(axis=0), light.shape)
            drawn = np.broadcast_to(np.arange(SIDE) < SIDE // 2, drawn.shape)
        factor = np.where(drawn[..., None], light / LIGHT, 1).astype(np.float32)
        return OPS.encode_srgb(OPS.decode_srgb(photo) * factor, photo.dtype)


def resized(strokes: Strokes, size) -> Strokes:
    rows, columns = (np.arange(n) * m // n for n, m in zip(size, strokes.mask.shape, strict=True))
    return Strokes(strokes.light[rows][:, columns], strokes.mask[rows][:, columns])


@dataclass(frozen=True)
class Estimates(Exact):
    """Estimates the photo to a power, in each channel."""

    power: float = 1.0

    def estimate(self, photo):
        return OPS.reduce_photo(photo, (32, 32)) ** np.float32(self.power)


def figures(table, row=0):
    return {name: figure.mean for name, figure in table.rows[row].figures.items()}


def test_light_in_proportion_has_slope_one() -> None:
    found = figures(slope([Exact()], [SUBJECT]))
    assert list(found) == ["x0.25 to x0.5", "x0.5 to x1", "x1 to x2", "x2 to x4", "x4 to x8"]
    assert list(found.values()) == pytest.approx([1] * 5, abs=1e-3)  # unclipped: x 8 goes far beyond white


def test_light_that_saturates_shows_in_the_last_steps() -> None:
    class Clipped(Exact):
        def relight(self, photo, strokes, blend="set"):
            return np.minimum(super().relight(photo, strokes, blend), 0.6)

    steps = list(figures(slope([Clipped()], [SUBJECT])).values())
    assert steps[0] == pytest.approx(1, abs=0.01) and steps[-1] < 0.3
    assert list(figures(slope([Copy()], [SUBJECT])).values()) == pytest.approx([0] * 5)


def test_black_surfaces_carry_no_slope() -> None:
    black = Subject("black", np.zeros_like(SUBJECT.photo), SUBJECT.marks)
    assert "(1)" in slope([Copy()], [SUBJECT, black]).control


def test_far_is_nothing_for_light_under_the_dab_alone_and_one_for_light_everywhere() -> None:
    table = far([Exact(), Exact("all", region="everywhere"), Exact("set", SET_ONLY)], [SUBJECT])
    assert [(row.method, row.control) for row in table.rows] == [
        *(("exact", blend) for blend in ("set", "add", "multiply")),
        *(("all", blend) for blend in ("set", "add", "multiply")),
        ("set", "set"),
    ]
    for row in table.rows:
        wanted = 1 if row.method == "all" else 0
        assert row.figures["logarithm"].mean == pytest.approx(wanted, abs=0.15)
    assert figures(far([Copy()], [SUBJECT])) == {"linear light": 0, "logarithm": 0}


def test_objects_tells_a_glow_from_light_that_ends_at_the_border() -> None:
    table = objects([Exact("object", region="object"), Exact("all", region="everywhere"), Copy()], [SUBJECT])
    ends, everywhere = table.rows  # copy changes nothing, so it has no row
    assert all(figure.mean == pytest.approx(0, abs=1e-6) for figure in ends.figures.values())
    assert all(figure.mean == pytest.approx(1, abs=0.2) for figure in everywhere.figures.values())
    assert "1 white, 1 blue, 1 dark" in table.control


def test_a_triple_counts_only_where_the_photo_has_room_for_the_change() -> None:
    bright = Subject("bright", np.full_like(SUBJECT.photo, 250), SUBJECT.marks)
    dark = Subject("dark", np.full_like(SUBJECT.photo, 8), SUBJECT.marks)
    triples = all_triples([bright, dark, SUBJECT])
    names = {kind: [subject.name for subject, _ in usable(triples, dab)] for kind, dab in DABS.items()}
    assert names == {"white": ["fields"], "blue": ["fields"], "dark": ["bright", "fields"]}


def test_form_of_a_ramp_is_blur_and_of_noise_is_not() -> None:
    ramp = np.repeat(np.linspace(0, 1, SIDE)[None, :, None], SIDE, axis=0)
    noise = np.random.default_rng(0).normal(size=(SIDE, SIDE))[..., None]
    assert blurred_share(ramp)[0] > 0.97
    assert blurred_share(noise)[0] < 0.05
    assert blurred_share(np.zeros((SIDE, SIDE, 3))) == (0, 0)
    table = form([Exact(), Glow(Exact()), Copy()], [SUBJECT])
    sharp, soft = (row.figures["explained by blur"].mean for row in table.rows)  # none for copy
    assert sharp < soft


def test_identity_of_an_exact_model_is_the_photo() -> None:
    class Doubles(Exact):
        def relight(self, photo, strokes, blend="set"):
            return OPS.encode_srgb(OPS.decode_srgb(photo) * np.float32(2), photo.dtype)

    found = figures(identity([Exact(), Doubles()], [SUBJECT]))
    assert found == {f"PSNR {mode}": pytest.approx(100) for mode in ("strokes", "coarse", "dense")}
    assert all(value < 25 for value in figures(identity([Doubles()], [SUBJECT])).values())


def test_material_slopes_are_the_power_of_the_estimate() -> None:
    for power in (1.0, 0.5):
        found = figures(material([Estimates(power=power)], [SUBJECT], "test"))
        assert found["chroma slope"] == pytest.approx(power, abs=0.12)
        assert found["luminance slope"] == pytest.approx(power, abs=0.12)
    flat = figures(material([Exact()], [SUBJECT], "test"))
    assert flat == {name: pytest.approx(0, abs=1e-6) for name in found}
    assert figures(material([Blur()], [SUBJECT], "test"))["R^2 to blur"] == pytest.approx(1)


def test_the_blur_formula_of_a_flat_picture() -> None:
    color = np.array([0.4, 0.2, 0.1], np.float32)
    luminance = color @ np.array([0.2126, 0.7152, 0.0722])
    found = blur_formula(np.broadcast_to(color, (16, 16, 3)))
    wanted = luminance**0.72 * ((color + 0.02) / (luminance + 0.02)) ** 0.55
    assert found == pytest.approx(np.broadcast_to(wanted, found.shape), rel=1e-4)


def test_glow_keeps_the_drawn_value_and_falls_with_the_distance() -> None:
    drawn = np.zeros((40, 40), bool)
    drawn[18:22, 18:22] = True
    value = np.where(drawn[..., None], np.float32([1.0, 0.5, -1.0]), 0)
    found = spread(value, drawn)
    assert np.array_equal(found[drawn], value[drawn])
    sigma = 8
    at = found[20, 21 + sigma]  # one sigma from the nearest drawn cell
    assert at == pytest.approx(np.float32([1.0, 0.5, -1.0]) * np.exp(-0.5), rel=1e-3)
    assert np.abs(found[0, 0]).max() < 0.05


def test_glow_answers_all_blends_alike_where_they_mean_the_same_light() -> None:
    """On an estimate of LIGHT, set 2 LIGHT, add LIGHT and multiply by 2 are one light."""
    glow, mask = Glow(Exact()), np.zeros((SIDE, SIDE), np.float32)
    mask[30:60, 10:40] = 1
    ones = np.where(mask[..., None] > 0, np.ones(3, np.float32), 0)
    one, two, three = (
        glow.relight(SUBJECT.photo, Strokes(ones * np.float32(value), mask), blend)
        for value, blend in ((2 * LIGHT, "set"), (LIGHT, "add"), (2, "multiply"))
    )
    assert np.array_equal(one, two)
    assert psnr(one, three) > 30  # but for the e of the quotient, and another grid
    assert psnr(one, SUBJECT.photo) < 25


def test_a_model_without_a_blend_mode_gets_the_light_that_it_stands_for() -> None:
    mask = np.zeros((SIDE, SIDE), np.float32)
    mask[24:72, 24:72] = 1
    strokes = Strokes(np.where(mask[..., None] > 0, np.full(3, 3, np.float32), 0), mask)
    knows, knows_not = Exact(), replace(Exact(), blends=SET_ONLY)
    for blend in ("set", "add", "multiply"):
        one, other = (drive(model, SUBJECT.photo, strokes, blend) for model in (knows, knows_not))
        assert np.array_equal(one, other)
    own = np.full((8, 8, 3), 0.5, np.float32)
    assert as_set(strokes, own, "multiply").light.max() == pytest.approx(1.5)
    assert as_set(strokes, own, "add").light.max() == pytest.approx(3.5)


def test_ratio_strokes_hold_the_factor_and_copy_scores_what_copying_scores(tmp_path) -> None:
    factor = np.ones((SIDE, SIDE, 1), np.float32)
    factor[:, SIDE // 2 :] = 2
    light = OPS.decode_srgb(SUBJECT.photo)
    truth = OPS.encode_srgb(light * factor, np.uint8)
    strokes = ratio_strokes(SUBJECT.photo, truth, 0)
    inner = (strokes.mask > 0) & (np.arange(SIDE) > SIDE // 2 + 8)
    assert strokes.light[inner] == pytest.approx(np.full((inner.sum(), 3), 1.85), abs=0.12)  # 2, less for e
    (tmp_path / "scene").mkdir()
    for name, picture in (("a", SUBJECT.photo), ("b", truth)):
        Image.fromarray(picture).save(tmp_path / "scene" / f"{name}.png")
    (table,) = ratio([Glow(Exact()), Copy()], tmp_path, 8)
    glow, copy = (row.figures["PSNR"].mean for row in table.rows)
    assert copy == pytest.approx(psnr(SUBJECT.photo, truth)) and glow > copy
    assert [task.name for task in real_pairs(tmp_path)[0]] == ["scene-b-a", "scene-a-b"]


def test_scale_invariant_psnr_forgives_one_factor_and_nothing_else() -> None:
    darker = OPS.encode_srgb(OPS.decode_srgb(SUBJECT.photo) * np.float32(0.5), np.uint8)
    assert scale_invariant_psnr(darker, SUBJECT.photo) > 40 > psnr(darker, SUBJECT.photo)
    tinted = OPS.encode_srgb(OPS.decode_srgb(SUBJECT.photo) * np.float32([0.5, 1, 1]), np.uint8)
    assert scale_invariant_psnr(tinted, SUBJECT.photo) < 30
    assert scale_invariant_psnr(SUBJECT.photo, SUBJECT.photo) == pytest.approx(100, abs=1)
    assert np.isfinite(scale_invariant_psnr(np.zeros_like(darker), darker))


def test_added_on_renders(renders) -> None:
    table = added([Glow(Exact()), Copy()], renders, 3)
    assert [(row.method, row.control) for row in table.rows] == [
        (name, blend) for name in ("glow", "copy") for blend in ("set", "add")
    ]
    copy = table.rows[-1].figures
    assert copy["PSNR still"].mean == pytest.approx(100) and copy["PSNR whole"].mean < 60
    assert table.rows[0].figures["PSNR still"].mean < 100


def test_ratio_of_sums() -> None:
    figure = ratio_of_sums([1, 3], [2, 2])
    assert figure.mean == 1 and figure.low == pytest.approx(0.5) and figure.high == pytest.approx(1.5)
    assert ratio_of_sums([0, 0], [0, 0]).mean == 0


def test_log_change_of_unclipped_floats() -> None:
    photo = np.full((4, 4, 3), 0.5, np.float32)
    light = OPS.decode_srgb(photo)
    after = OPS.encode_srgb(light * np.float32(10), np.float32)
    assert log_change(photo, after) == pytest.approx(np.log((10 * light + 0.02) / (light + 0.02)), rel=1e-4)


def test_the_marks_are_sound() -> None:
    """At least 30 triples on 12 photos, their points in the photo, apart from the dab, at one distance."""
    found = marked_photos()
    assert len(found) == 12 and len(all_triples(found)) >= 30
    for kind in DABS.values():
        assert len(usable(all_triples(found), kind)) >= 20
    for subject, triple in all_triples(found):
        height, width = subject.photo.shape[:2]
        side = min(height, width)
        inside, outside = (np.hypot(*np.subtract(at, triple.dab)) for at in (triple.inside, triple.outside))
        assert inside == pytest.approx(outside, rel=0.03), (subject.name, triple.name)
        assert min(inside, outside) > 0.07 * side
        for x, y in (triple.dab, triple.inside, triple.outside):
            assert 0.01 * side < x < width - 0.01 * side and 0.01 * side < y < height - 0.01 * side


def test_photos_that_are_missing_are_named(monkeypatch, tmp_path) -> None:
    with pytest.raises(InputError, match=r"needs a package: pip install no_such_package"):
        find_photo("no_such_package:a.png")
    with pytest.raises(InputError, match="does not hold the photo"):
        find_photo("skimage:data/none.png")
    monkeypatch.setattr(photos, "CLONE", tmp_path)
    with pytest.raises(InputError, match="Run the judges in a clone"):
        find_photo("examples/coffee.jpg")
    (tmp_path / "marks.json").write_text(json.dumps({"photos": [{"photo": "examples/coffee.jpg"}]}))
    with pytest.raises(InputError, match="Cannot read the marks"):
        marked_photos(tmp_path / "marks.json")
    with pytest.raises(InputError, match="There are no pictures"):
        folder_photos(tmp_path)


def test_a_folder_of_photos_leaves_out_probes_and_materials(tmp_path) -> None:
    for name in ("a/dir_0_mip6.jpg", "a/materials_mip4.png", "a/probes/dir_0.jpg", "b.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(SUBJECT.photo).save(tmp_path / name)
    assert [subject.name for subject in folder_photos(tmp_path)] == ["dir_0_mip6", "b"]


def test_names_of_judges() -> None:
    assert parse_judges("far, slope,far") == ("far", "slope")
    assert set(parse_judges(",".join(JUDGES))) == set(JUDGES)
    for wrong in ("far,beauty", ""):
        with pytest.raises(InputError, match="Choose from material, objects"):
            parse_judges(wrong)


def test_judges_from_end_to_end(mini_bundle, tmp_path, capfd) -> None:
    Image.fromarray(SUBJECT.photo).save(tmp_path / "photo.png")
    asked = [
        "train",
        "eval",
        str(mini_bundle),
        str(tmp_path),
        "--steps",
        "1",
        "--out",
        str(tmp_path / "report"),
    ]
    assert cli([*asked, "--judges", "material,identity,far", "--json"]) == 0
    report = json.loads(capfd.readouterr().out)
    names = [table["benchmark"] for table in report["tables"]]
    assert names == [f"material, {tmp_path.name}", "identity", "far"]
    assert [row["method"] for row in report["tables"][1]["rows"]] == ["small", "glow", "blur", "copy"]
    assert "| small | set |" in (tmp_path / "report" / "report.md").read_text()


def test_what_a_judge_cannot_work_on_is_told(mini_bundle, tmp_path, capfd) -> None:
    Image.fromarray(SUBJECT.photo).save(tmp_path / "photo.png")
    for where, judges, saying in (
        (tmp_path, "objects", "needs marks. Write the word photos"),
        ("photos", "added", "needs a folder of renders"),
        ("photos", "ratio", "needs a folder of pairs"),
        (tmp_path / "none", "far", "There are no pictures"),
        (tmp_path, "ratio", "There are no pairs of photos"),
        (tmp_path, "beauty", "There is no judge beauty"),
    ):
        assert cli(["train", "eval", str(mini_bundle), str(where), "--judges", judges]) == 2
        said = capfd.readouterr()
        assert said.err.count("\n") == 1 and saying in said.err and not said.out
