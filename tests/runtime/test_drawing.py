"""Shapes and projects: what a person drew, as a raster and as a file."""

import dataclasses
import io
import json
import zipfile

import numpy as np
import pytest

from dior_rt.drawing import Paint, Painter, Shape, canvas_size, draw
from dior_rt.errors import InputError
from dior_rt.project import (
    LightRecord,
    PhotoRef,
    Project,
    Settings,
    ShapeRecord,
    lights_of,
    pack,
    parse_project,
    read_project,
    unpack,
    write_project,
)
from dior_rt.records import unparse

PHOTO = (100, 150)
HARD = Paint(softness=0.0)


def mask(*shapes, photo=PHOTO):
    return draw(shapes, photo).mask


def test_a_hard_stroke_covers_its_width_and_no_more():
    covered = mask(Shape("stroke", ((20, 50), (120, 50)), HARD, width=20))
    assert (covered[42:58, 30:110] == 1).all()
    assert covered[:38].max() == 0 and covered[62:].max() == 0
    assert covered.sum() == pytest.approx(100 * 20 + np.pi * 100, rel=0.01)


def test_softness_falls_from_the_middle_to_the_border():
    column = mask(Shape("stroke", ((20, 50), (120, 50)), Paint(softness=1.0), width=40))[:, 70]
    assert (np.diff(column[30:50]) >= 0).all() and column[50] > 0.9 and 0.3 < column[40] < 0.7


def test_pressure_acts_on_width_or_on_strength_as_asked():
    line = {"points": ((20, 50), (130, 50)), "paint": HARD, "width": 30, "pressure": (0.0, 1.0)}
    plain, thin, faint = (
        mask(Shape("stroke", **line)),
        mask(Shape("stroke", **line, thins=True)),
        mask(Shape("stroke", **line, fades=True)),
    )
    assert (plain[:, 25] > 0).sum() == (plain[:, 125] > 0).sum()
    assert (thin[:, 25] > 0).sum() < 0.4 * (thin[:, 125] > 0).sum()
    assert faint[50, 25] < 0.2 and faint[50, 128] > 0.9


def test_low_flow_builds_up_stroke_by_stroke_but_not_within_one():
    cross = ((20, 50), (120, 50), (20, 50))
    one = mask(Shape("stroke", cross, Paint(flow=0.5, softness=0), width=20))
    assert one.max() == pytest.approx(0.5)
    dab = Shape("stroke", ((75, 50),), Paint(flow=0.5, softness=0), width=20)
    assert mask(dab, dab)[50, 75] == pytest.approx(0.75)


def test_an_eraser_takes_away_and_leaves_the_light_of_the_rest():
    warm = Paint((1.0, 0.5, 0.25), 2.0, softness=0)
    strokes = draw(
        [
            Shape("stroke", ((20, 50), (120, 50)), warm, width=20),
            Shape("stroke", ((70, 50),), Paint(erase=True, softness=0), width=24),
        ],
        PHOTO,
    )
    assert strokes.mask[50, 70] == 0 and strokes.mask[50, 30] == 1
    assert np.allclose(strokes.light[50, 30], [2, 1, 0.5])


def test_later_strokes_lie_over_earlier_ones():
    red, blue = Paint((1, 0, 0), softness=0), Paint((0, 0, 1), flow=0.25, softness=0)
    strokes = draw(
        [Shape("stroke", ((75, 50),), red, width=20), Shape("stroke", ((75, 50),), blue, width=20)], PHOTO
    )
    assert np.allclose(strokes.light[50, 75], [0.75, 0, 0.25]) and strokes.mask[50, 75] == 1


def test_a_fill_covers_its_outline_and_a_gradient_falls_along_its_line():
    square = mask(Shape("fill", ((30, 20), (80, 20), (80, 70), (30, 70)), HARD))
    assert square[45, 55] == 1 and square[45, 20] == 0 and square.sum() == pytest.approx(2500, rel=0.05)
    row = mask(Shape("gradient", ((0, 50), (150, 50))))[50]
    assert row[0] > 0.99 and row[-1] < 0.01 and (np.diff(row) <= 0).all()


def test_a_glow_is_an_ellipse_in_any_direction():
    covered = mask(Shape("glow", ((75, 50), (115, 50), (75, 70)), Paint(softness=1.0)))
    assert covered[50, 75] > 0.99
    assert covered[50, 112] > 0 and covered[50, 116] == 0 and covered[71, 75] == 0
    assert mask(Shape("glow", ((75, 50), (75, 50), (75, 70)))).max() == 0  # of no width


def test_shapes_far_outside_draw_nothing():
    far = ((-5e5, -5e5), (-4e5, -4e5))
    assert mask(Shape("stroke", far, width=100)).max() == 0
    assert mask(Shape("fill", (*far, (-4e5, -5e5)))).max() == 0


def test_a_large_photo_is_drawn_on_a_small_canvas_with_the_same_meaning():
    small = mask(Shape("stroke", ((20, 50), (120, 50)), HARD, width=20))
    large = draw([Shape("stroke", ((800, 2000), (4800, 2000)), HARD, width=800)], (4000, 6000))
    assert large.mask.shape == canvas_size((4000, 6000)) == (512, 768)
    assert large.mask.mean() == pytest.approx(small.mean(), rel=0.02)


def test_a_painter_draws_on_what_it_has_kept():
    shapes = [Shape("stroke", ((x, 50), (x + 20, 60)), Paint(flow=0.6), width=20) for x in range(20, 100, 20)]
    painter = Painter(PHOTO)
    for count in (1, 3, 4, 2, 4):
        strokes, fresh = painter.draw("light", shapes[:count]), draw(shapes[:count], PHOTO)
        assert np.array_equal(strokes.mask, fresh.mask) and np.array_equal(strokes.light, fresh.light)
    assert painter.draw("light", shapes) is strokes  # the same shapes, the same raster


# Projects

STROKE = ShapeRecord("stroke", ((20.0, 50.0), (120.0, 50.0)), (1.0, 0.5, 0.25), intensity=2.0, width=20.0)
PROJECT = Project(
    PhotoRef((150, 100), "photo.jpg", "ab" * 32),
    (LightRecord("Key", "add", shapes=(STROKE,), reach=0.2), LightRecord("Flag", "multiply", on=False)),
    Settings(seed=7),
)


def test_a_project_comes_back_from_its_file_as_it_was(tmp_path):
    write_project(tmp_path / "p.dior", PROJECT)
    assert read_project(tmp_path / "p.dior") == PROJECT
    assert pack(PROJECT) == pack(unpack(pack(PROJECT)))  # byte by byte


def test_a_projects_lights_are_its_layers():
    key, flag = lights_of(PROJECT, PHOTO)
    assert (key.name, key.blend, key.reach, key.on) == ("Key", "add", 0.2, True)
    assert np.allclose(key.drawn.light[50, 70], [2, 1, 0.5])
    assert (flag.on, flag.drawn.mask.max()) == (False, 0)


def test_where_one_light_is_solo_the_others_are_off():
    lights = (LightRecord("a"), LightRecord("b", solo=True), LightRecord("c", solo=True, on=False))
    project = dataclasses.replace(PROJECT, lights=lights)
    assert [light.on for light in lights_of(project, PHOTO)] == [False, True, False]


def test_a_photo_of_another_size_is_refused():
    with pytest.raises(InputError, match="150 x 100 pixels, and this one has 90 x 60"):
        lights_of(PROJECT, (60, 90))


def changed(path, value):
    document, value = json.loads(json.dumps([unparse(PROJECT), value]))
    place = document
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return document


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["format"], "other", "not a project"),
        (["version"], 2, "version"),
        (["lights"], [unparse(LightRecord())] * 65, "more than 64 lights"),
        (["lights", 0, "blend"], "screen", "blend"),
        (["lights", 0, "shapes", 0, "points"], [], "at least 1 points"),
        (["lights", 0, "shapes", 0, "points"], [[1e9, 0]], "within"),
        (["lights", 0, "shapes", 0, "points"], [[1]], r"\[x, y\]"),
        (["lights", 0, "shapes", 0, "pressure"], [0.5], "one pressure for each point"),
        (["lights", 0, "shapes", 0, "flow"], 2.0, "0..1"),
        (["lights", 0, "shapes", 0, "width"], 0, "width"),
        (["lights", 0, "shapes", 0, "color"], [1.0, -1.0, 0.0], "color"),
        (["lights", 0, "extra"], 1, "unknown key 'extra'"),
        (["photo", "size"], [0, 5], "photo.size"),
    ],
)
def test_a_project_that_cannot_be_names_the_place(path, value, message):
    with pytest.raises(ValueError, match=message):
        parse_project(changed(path, value))


def zipped(name, data):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return file.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"no zip",
        pack(PROJECT)[:-30],
        bytes(b ^ (0x55 if 60 < i < 120 else 0) for i, b in enumerate(pack(PROJECT))),
        zipped("other.json", "{}"),
        zipped("project.json", "{"),
        zipped("project.json", "[" * 100_000),
        zipped("project.json", '{"format": "dior project", "version": 1}'),
        zipped("project.json", b"\xff\xfe"),
    ],
    ids=["empty", "no zip", "cut", "damaged", "no entry", "no JSON", "deep", "no keys", "no text"],
)
def test_a_damaged_project_is_one_sentence(tmp_path, data):
    path = tmp_path / "p.dior"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"^Cannot read the project .*p\.dior: .*\.$"):
        read_project(path)
