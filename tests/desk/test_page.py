"""The page in a real browser: the user's actions with mouse, pen and keyboard, and the visible results.

The main way through the page is always tested, the rest with -m slow.
"""

from __future__ import annotations

import io
import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run
from dior_rt.project import read_project

TIMEOUT = 60_000  # milliseconds; a busy machine needs more time


class Page:
    """The desk in a tab."""

    def __init__(self, tab):
        self.tab = tab
        self.errors = []
        tab.set_default_timeout(TIMEOUT)
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.on("console", lambda said: said.type == "error" and self.errors.append(said.text))

    def open(self, link):
        self.tab.goto(link)
        self.tab.wait_for_selector("html[data-ready=true]")
        return self

    @property
    def previews(self):
        return int(self.tab.evaluate("document.documentElement.dataset.previews ?? 0"))

    @contextmanager
    def new_preview(self):
        """Wait, after the block, until all that it requested is visible."""
        before = self.previews
        yield
        for _ in range(600):
            if self.previews > before and not self.tab.locator(".stage.busy").count():
                return
            self.tab.wait_for_timeout(100)
        raise AssertionError(f"no preview came; the page says: {self.said}")

    def reload(self):
        """Load the page again, and wait for its first preview."""
        self.tab.reload()
        self.tab.wait_for_selector("html[data-ready=true][data-previews]")

    @property
    def said(self):
        return self.tab.locator(".said").inner_text()

    def at(self, x, y):
        """Return the place on the screen of a place on the photo, in shares of its sides."""
        box = self.tab.locator(".stage").bounding_box()
        margin, (width, height) = 20, (480, 320)
        scale = min((box["width"] - 2 * margin) / width, (box["height"] - 2 * margin) / height)
        left = box["x"] + (box["width"] - scale * width) / 2
        top = box["y"] + (box["height"] - scale * height) / 2
        return left + x * scale * width, top + y * scale * height

    def draw(self, *points):
        """Drag the mouse over points of the photo."""
        with self.new_preview():
            self.tab.mouse.move(*self.at(*points[0]))
            self.tab.mouse.down()
            for point in points[1:]:
                self.tab.mouse.move(*self.at(*point), steps=6)
            self.tab.mouse.up()
        self.tab.mouse.move(*self.at(0.99, 0.01))

    def seen(self):
        """Return the content of the stage, (200, 300, 3), without the brush's ring."""
        left, top = self.at(0, 0)
        right, bottom = self.at(1, 1)
        clip = {"x": left, "y": top, "width": right - left, "height": bottom - top}
        shot = Image.open(io.BytesIO(self.tab.screenshot(clip=clip))).convert("RGB")
        return np.asarray(shot.resize((300, 200)), np.int16)

    def count_lights(self):
        return self.tab.locator(".lights li").count()

    def button(self, name):
        return self.tab.get_by_role("button", name=name, exact=True)

    def saved(self, tmp_path, name="saved.dior"):
        """Return the project as the page saves it."""
        with self.tab.expect_download() as download:
            self.button("Save").click()
        path = tmp_path / name
        download.value.save_as(path)
        return path


@pytest.fixture
def page(profile, desk):
    page = Page(profile.new_page()).open(desk.link)
    yield page
    assert page.errors == []


STROKE = [(0.2, 0.2), (0.25, 0.4), (0.3, 0.6)]


def change(before, after):
    """Return the mean change of the part that was drawn on, and of the far corner."""
    difference = after - before
    return difference[60:100, 65:85].mean(), np.abs(difference[150:190, 230:290]).mean()


def test_a_stroke_brightens_where_it_was_drawn_and_nothing_elsewhere(page):
    before = page.seen()
    page.draw(*STROKE)
    drawn, elsewhere = change(before, page.seen())
    assert drawn > 12 and elsewhere < 1.5
    assert page.count_lights() == 1


def test_undo_and_redo_take_back_strokes_and_sliders(page):
    before = page.seen()
    page.draw(*STROKE)
    lit = page.seen()
    strength = page.tab.locator(".editor").get_by_label("Strength")
    with page.new_preview():
        strength.fill("3")
    assert page.seen().mean() > lit.mean()
    with page.new_preview():
        page.tab.keyboard.press("Control+z")
    assert strength.input_value() == "1"
    assert np.abs(page.seen() - lit).mean() < 0.5
    with page.new_preview():
        page.button("Undo").click()
    assert np.abs(page.seen() - before).mean() < 0.5 and page.count_lights() == 0
    with page.new_preview():
        page.tab.keyboard.press("Control+Shift+z")
    assert np.abs(page.seen() - lit).mean() < 0.5 and page.count_lights() == 1


@pytest.mark.slow
def test_mute_and_solo_take_lights_out_of_the_picture(page):
    before = page.seen()
    page.draw(*STROKE)
    with page.new_preview():
        page.button("Light 1: on").click()
    assert np.abs(page.seen() - before).mean() < 0.5
    with page.new_preview():
        page.tab.locator("select.add").select_option("windowRight")
    window = page.seen()
    with page.new_preview():
        page.button("Light 1: off").click()
    with page.new_preview():
        page.button("Solo Window, right").click()
    assert np.abs(page.seen() - window).mean() < 0.5


@pytest.mark.slow
def test_a_light_is_tinted_after_it_was_drawn(page):
    page.draw(*STROKE)
    warm = page.seen()
    with page.new_preview():
        page.button("Tint: Moon").click()
    cold = page.seen()
    red, _, blue = (cold - warm)[60:100, 65:85].mean(axis=(0, 1))
    assert red < -5 and red < blue


@pytest.mark.slow
def test_blend_modes_set_and_multiply_can_darken(page):
    page.tab.locator("aside").get_by_label("Strength").first.fill("0.1")
    before = page.seen()
    page.draw(*STROKE)
    added = change(before, page.seen())[0]
    with page.new_preview():
        page.tab.get_by_role("group", name="Blend").get_by_text("Multiply").click()
    assert added > -1 and change(before, page.seen())[0] < -10


def pen(page, points, pressures):
    """Pull a pen over points of the photo, with a pressure at each."""
    session = page.tab.context.new_cdp_session(page.tab)
    for i, (point, force) in enumerate(zip(points, pressures, strict=True)):
        x, y = page.at(*point)
        kind = "mousePressed" if i == 0 else "mouseMoved"
        common = {"x": x, "y": y, "pointerType": "pen", "button": "left", "clickCount": 1}
        session.send("Input.dispatchMouseEvent", {"type": kind, "buttons": 1, "force": force, **common})
    session.send("Input.dispatchMouseEvent", {"type": "mouseReleased", "buttons": 0, "force": 0, **common})


def test_a_pen_draws_with_its_pressure(page, tmp_path):
    points = [(0.2 + 0.06 * i, 0.5) for i in range(10)]
    with page.new_preview():
        pen(page, points, np.linspace(0.1, 1, 10))
    (shape,) = read_project(page.saved(tmp_path)).lights[0].shapes
    assert shape.thins and len(shape.pressure) == len(shape.points) >= 10
    assert shape.pressure[0] < 0.2 < 0.9 < shape.pressure[-1]


@pytest.mark.slow
def test_every_tool_makes_its_shape(page, tmp_path):
    ways = {
        "Lasso fill": [(0.2, 0.2), (0.5, 0.2), (0.5, 0.5), (0.2, 0.5)],
        "Gradient": [(0.1, 0.5), (0.9, 0.5)],
        "Glow": [(0.5, 0.5), (0.7, 0.5)],
        "Eraser": STROKE,
        "Brush": STROKE,
    }
    for name, way in ways.items():
        page.button(name).click()
        page.draw(*way)
    shapes = read_project(page.saved(tmp_path)).lights[0].shapes
    assert [shape.kind for shape in shapes] == ["fill", "gradient", "glow", "stroke", "stroke"]
    assert [shape.erase for shape in shapes] == [False, False, False, True, False]


@pytest.mark.slow
def test_shift_draws_a_straight_line(page, tmp_path):
    page.tab.keyboard.down("Shift")
    page.draw((0.2, 0.2), (0.4, 0.7), (0.8, 0.3))
    page.tab.keyboard.up("Shift")
    (shape,) = read_project(page.saved(tmp_path)).lights[0].shapes
    assert np.allclose(shape.points, [(96, 64), (384, 96)], atol=2)


@pytest.mark.slow
def test_the_eyedropper_takes_the_photos_colour(page, photo_file, tmp_path):
    page.button("Pick a colour from the photo").click()
    page.tab.mouse.click(*page.at(0.9, 0.9))
    page.draw(*STROKE)
    (shape,) = read_project(page.saved(tmp_path)).lights[0].shapes
    with Image.open(photo_file) as photo:
        picked = (np.array(photo.getpixel((432, 288))) / 255) ** 2.2
    assert np.allclose(shape.color, picked / picked.max(), atol=0.08)


def test_the_export_is_the_command_lines_result_of_the_saved_project(page, photo_file, mini_bundle, tmp_path):
    page.draw(*STROKE)
    with page.new_preview():
        page.tab.locator("select.add").select_option("moonlight")
    page.button("Export").click()
    assert "dior-rt relight scene.png scene.dior" in page.tab.locator("dialog code").inner_text()
    with page.tab.expect_download() as download:
        page.tab.get_by_role("button", name="PNG", exact=True).click()
    download.value.save_as(tmp_path / "page.png")
    saved, out = page.saved(tmp_path), tmp_path / "cli.png"
    model = ["--bundle", str(mini_bundle), "--device", "cpu", "--ops", "numpy"]
    assert run(["relight", str(photo_file), str(saved), "-o", str(out), *model]) == 0
    assert (tmp_path / "page.png").read_bytes() == out.read_bytes()


@pytest.mark.slow
def test_a_full_result_takes_the_previews_place(page):
    page.draw(*STROKE)
    preview = page.seen()
    page.button("Relight").click()
    page.tab.get_by_text("Relit at full size").wait_for()
    assert np.abs(page.seen() - preview).mean() < 8
    assert page.tab.locator("header progress").is_hidden()


def test_a_reload_loses_nothing(page, tmp_path):
    page.draw(*STROKE)
    page.tab.locator(".editor").get_by_label("Name").fill("Window light")
    page.tab.keyboard.press("Tab")
    lit, before = page.seen(), read_project(page.saved(tmp_path, "before.dior"))
    page.tab.wait_for_selector("html[data-saved=true]")
    page.tab.wait_for_timeout(600)
    page.reload()
    assert page.tab.locator(".lights .name").all_inner_texts() == ["Window light"]
    assert np.abs(page.seen() - lit).mean() < 1
    assert read_project(page.saved(tmp_path, "after.dior")) == before


@pytest.mark.slow
def test_two_tabs_have_drawings_of_their_own(page, profile, desk, tmp_path):
    page.draw(*STROKE)
    other = Page(profile.new_page()).open(desk.link)
    assert other.count_lights() == 0
    other.draw((0.6, 0.6), (0.8, 0.8))
    other.draw((0.7, 0.6), (0.6, 0.8))
    for tab in (page, other):
        tab.tab.wait_for_timeout(600)
    page.reload()
    assert len(read_project(page.saved(tmp_path, "1.dior")).lights[0].shapes) == 1
    assert len(read_project(other.saved(tmp_path, "2.dior")).lights[0].shapes) == 2
    assert other.errors == []


@pytest.mark.slow
def test_a_project_is_opened_again_and_a_damaged_one_is_one_sentence(page, tmp_path):
    page.draw(*STROKE)
    lit, path = page.seen(), page.saved(tmp_path)
    with page.new_preview():
        page.button("Delete").click()
    with page.new_preview():
        page.tab.locator("input[type=file]").set_input_files(path)
    assert np.abs(page.seen() - lit).mean() < 0.5
    (tmp_path / "broken.dior").write_bytes(path.read_bytes()[:-30])
    page.tab.locator("input[type=file]").set_input_files(tmp_path / "broken.dior")
    page.tab.locator(".said.error").wait_for()
    assert page.said.startswith("Cannot read the project: ") and page.count_lights() == 1
    page.errors = [error for error in page.errors if "400" not in error]  # the browser's own note


@pytest.mark.slow
def test_an_empty_desk_opens_a_photo_and_refuses_what_is_none(profile, empty_desk, photo_file, tmp_path):
    page = Page(profile.new_page()).open(empty_desk.link)
    assert page.tab.get_by_text("Drop a photo here").is_visible()
    (tmp_path / "text.jpg").write_text("no picture")
    page.tab.locator("input[type=file]").set_input_files(tmp_path / "text.jpg")
    page.tab.locator(".said.error").wait_for()
    assert page.said.startswith("Cannot read the photo text.jpg: ")
    page.tab.locator("input[type=file]").set_input_files(photo_file)
    page.tab.wait_for_selector("html[data-photo]")
    assert page.tab.get_by_text("Drop a photo here").is_hidden()
    page.draw(*STROKE)


@pytest.mark.slow
def test_maps_overlays_and_the_divider_show_what_they_say(page):
    page.draw(*STROKE)
    plain = page.seen()
    for key, name in (("s", "Source map"), ("t", "Target map"), ("d", "Drawn")):
        page.tab.keyboard.press(key)
        assert page.button(name).get_attribute("aria-pressed") == "true"
        page.tab.wait_for_timeout(700)
        assert np.abs(page.seen() - plain).mean() > 10
    page.tab.keyboard.press("d")
    page.tab.keyboard.press("\\")
    photo = page.seen()
    page.tab.keyboard.press("c")
    half = page.seen()
    assert np.abs(half[:, :140] - photo[:, :140]).mean() < 3  # left of the divider, the photo
    divider = page.tab.get_by_role("slider", name="Divider between photo and result")
    divider.press("ArrowRight")
    assert divider.get_attribute("aria-valuenow") == "52"


@pytest.mark.slow
def test_snapshots_bring_a_state_back(page):
    page.draw(*STROKE)
    lit = page.seen()
    page.button("Take a snapshot").click()
    with page.new_preview():
        page.button("Delete").click()
    page.button("Take a snapshot").click()
    page.button("Side by side").click()
    assert page.tab.locator("dialog figure").count() == 2
    page.tab.keyboard.press("Escape")
    with page.new_preview():
        page.button("Restore snapshot A").click()
    assert np.abs(page.seen() - lit).mean() < 0.5


@pytest.mark.parametrize(
    ("scheme", "size"),
    [
        ("dark", (1280, 800)),
        pytest.param("light", (1280, 800), marks=pytest.mark.slow),
        pytest.param("dark", (390, 844), marks=pytest.mark.slow),
        pytest.param("light", (390, 844), marks=pytest.mark.slow),
    ],
    ids=["dark", "light", "dark phone", "light phone"],
)
def test_axe_finds_no_violation(page, scheme, size):
    pytest.importorskip("axe_playwright_python", reason="axe-playwright-python is not installed")
    import axe_playwright_python

    page.draw(*STROKE)
    page.tab.emulate_media(color_scheme=scheme)
    page.tab.set_viewport_size({"width": size[0], "height": size[1]})
    page.tab.evaluate((Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text())

    def violations():
        found = page.tab.evaluate("axe.run()")["violations"]
        return {
            one["id"]: [node["failureSummary"] + node["html"][:200] for node in one["nodes"]] for one in found
        }

    assert violations() == {}
    if size[0] > 1000:
        page.button("Export").click()
        assert violations() == {}
        page.tab.keyboard.press("Escape")
        page.button("Keyboard shortcuts").click()
        assert violations() == {}


def test_the_page_fits_a_phone(page):
    page.tab.set_viewport_size({"width": 390, "height": 844})
    page.tab.wait_for_timeout(300)
    widths = page.tab.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert widths[0] <= widths[1]
    stage = page.tab.locator(".stage").bounding_box()
    assert stage["width"] == 390 and stage["height"] > 220
    page.button("Glow").click()
    assert json.loads(page.button("Glow").get_attribute("aria-pressed"))


@pytest.mark.slow
def test_keys_change_the_brush_and_the_view(page):
    size = page.tab.locator("aside").get_by_label("Size")
    before = float(size.input_value())
    page.tab.keyboard.press("]")
    assert float(size.input_value()) > before
    page.tab.keyboard.press("e")
    assert page.button("Eraser").get_attribute("aria-pressed") == "true"
    zoom = page.tab.locator(".zoom").inner_text()
    page.tab.keyboard.press("+")
    assert page.tab.locator(".zoom").inner_text() != zoom
    page.tab.keyboard.press("0")
    assert page.tab.locator(".zoom").inner_text() == zoom
