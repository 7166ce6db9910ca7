"""The server without a browser: who may speak to it, what it answers, and what it refuses."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import httpx
import numpy as np
import pytest
from PIL import Image

from dior_rt.cli import run
from dior_rt.desk.guard import new_token
from dior_rt.desk.jobs import Queue
from dior_rt.errors import Cancelled, InputError
from dior_rt.project import unpack

STROKE = {
    "kind": "stroke", "points": [[120, 80], [200, 160]], "color": [1, 0.7, 0.4], "intensity": 3, "flow": 1,
    "softness": 0.5, "erase": False, "width": 60, "pressure": [0.5, 1], "thins": True, "fades": False,
}  # fmt: skip
LIGHT = {
    "name": "Key", "blend": "add", "on": True, "solo": False, "strength": 1, "tint": [1, 1, 1], "reach": 0.1,
    "shapes": [STROKE],
}  # fmt: skip


def project(*lights, steps=None, size=(480, 320)):
    return {
        "format": "dior project",
        "version": 1,
        "photo": {"size": list(size), "name": "scene.png", "sha256": ""},
        "settings": {"preset": None, "steps": steps, "seed": 0, "intensity": 1},
        "lights": list(lights),
    }


@pytest.fixture(scope="module")
def client(desk):
    with httpx.Client(base_url=desk.link, timeout=60) as client:
        yield client


@pytest.fixture(scope="module")
def photo(client):
    return client.post("api/photos/first").json()["id"]


def relit(client, photo, wanted):
    """The id of a job that is done."""
    job = client.post(f"api/photos/{photo}/jobs", json=wanted).json()["job"]
    events = client.get(f"api/jobs/{job}/events").text
    assert '"stage": "done"' in events
    return job


def pixels(response):
    assert response.status_code == 200, response.text
    return np.asarray(Image.open(io.BytesIO(response.content)), np.int16)


# Access control


def test_a_stranger_without_the_token_is_refused(desk):
    for path in ("/", "/api/desk", "/index.html", "/wrong/api/desk", f"/{new_token()}/", "/../x"):
        answer = httpx.get(f"http://{desk.host}{path}")
        assert answer.status_code == 403 and "token" in answer.text
    assert httpx.post(f"http://{desk.host}/api/photos", content=b"x").status_code == 403


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "attacker.example"},
        {"Host": "127.0.0.1:1"},
        {"Origin": "http://attacker.example"},
        {"Origin": "null"},
        {"Sec-Fetch-Site": "cross-site"},
    ],
)
def test_another_host_or_origin_is_refused_even_with_the_token(desk, headers):
    assert httpx.get(f"{desk.link}api/desk", headers=headers).status_code == 403


def test_the_page_itself_may_speak_and_is_told_to_load_nothing_from_elsewhere(desk):
    headers = {"Origin": f"http://{desk.host}", "Sec-Fetch-Site": "same-origin"}
    assert httpx.get(f"{desk.link}api/desk", headers=headers).status_code == 200
    page = httpx.get(desk.link)
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy and "unsafe" not in policy
    assert page.headers["referrer-policy"] == "no-referrer"


def test_files_outside_the_page_are_not_served(client):
    for name in ("app.py", "..%2fapp.py", "__init__.py", "%2e%2e/app.py", "nothing.js"):
        assert client.get(name).status_code in (404, 403)


def test_the_page_is_light_and_fetches_nothing_from_elsewhere():
    import gzip
    import re
    from importlib.resources import files

    page = [file for file in files("dior_rt.desk").joinpath("page").iterdir() if file.is_file()]
    assert sum(len(gzip.compress(file.read_bytes(), 9)) for file in page) <= 60_000
    for file in page:
        links = set(re.findall(r"https?://[^\s'\"`)]+", file.read_text()))
        assert links <= {"http://www.w3.org/2000/svg"}


# Photos


def test_a_photo_is_opened_by_its_bytes(client, photo_file, photo, desk):
    opened = client.post("api/photos?name=../scene.png", content=photo_file.read_bytes()).json()
    assert opened == {
        "id": photo, "name": "scene.png", "size": [480, 320], "bits": 8, "transparent": False, "notices": [],
    }  # fmt: skip
    assert list(desk.folder.iterdir()) == []  # the upload is gone


def test_a_photo_with_a_profile_is_shown_with_it(client, photo_file):
    """Display P3 has sRGB's curve, so a preview's pixels and the profile belong together."""
    from PIL import ImageCms

    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    file = io.BytesIO()
    with Image.open(photo_file) as picture:
        picture.save(file, "PNG", icc_profile=profile)
    opened = client.post("api/photos?name=p3.png", content=file.getvalue()).json()
    shown = Image.open(io.BytesIO(client.get(f"api/photos/{opened['id']}/picture").content))
    assert shown.info.get("icc_profile") == profile


@pytest.mark.parametrize("data", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + bytes(50)])
def test_a_corrupt_photo_is_one_sentence_and_leaves_nothing(client, desk, data):
    answer = client.post("api/photos?name=broken.png", content=data)
    assert answer.status_code == 422
    assert answer.json()["error"].startswith("Cannot read the photo broken.png: ")
    assert str(desk.folder) not in answer.text
    assert list(desk.folder.iterdir()) == []


def test_a_body_that_is_too_long_is_refused_before_it_is_read(client, photo, monkeypatch):
    monkeypatch.setattr("dior_rt.desk.app.MOST_PHOTO_BYTES", 1 << 20)
    assert client.post("api/photos", content=bytes(2 << 20)).status_code == 413

    def parts():  # without a length that could be checked beforehand
        for _ in range(64):
            yield bytes(1 << 16)

    assert client.post("api/photos", content=parts()).status_code == 413


def test_a_photo_of_50_megapixels_is_previewed_small(client, tmp_path):
    large = np.zeros((5800, 8700, 3), np.uint8)
    large[:, :, 0] = np.linspace(20, 200, 8700).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(large).save(file, "JPEG", quality=80)
    opened = client.post("api/photos?name=large.jpg", content=file.getvalue()).json()
    assert opened["size"] == [8700, 5800]
    stroke = {**STROKE, "points": [[2000, 2000], [3000, 3000]], "width": 900}
    wanted = project({**LIGHT, "shapes": [stroke]}, size=(8700, 5800))
    preview = pixels(client.post(f"api/photos/{opened['id']}/preview?longest=1024", json=wanted))
    assert preview.shape == (683, 1024, 3)
    plain = pixels(client.get(f"api/photos/{opened['id']}/picture?longest=1024"))
    assert (preview - plain)[235:350, 235:350].mean() > 5


def test_a_photo_that_is_not_open_is_not_found(client):
    answer = client.post(f"api/photos/{'0' * 64}/preview", json=project(LIGHT))
    assert answer.status_code == 404 and "open it again" in answer.json()["error"]


# Light


def test_a_preview_changes_where_it_was_drawn_and_not_elsewhere(client, photo):
    before = pixels(client.get(f"api/photos/{photo}/picture?longest=480"))
    after = pixels(client.post(f"api/photos/{photo}/preview?longest=480", json=project(LIGHT)))
    assert (after - before)[100:140, 140:180].mean() > 10
    assert np.abs(after - before)[250:, 380:].mean() < 1.5


def test_an_older_preview_gives_way_to_a_newer_one(client, photo):
    address = f"api/photos/{photo}/preview?page=p"
    assert client.post(f"{address}&number=7", json=project(LIGHT)).status_code == 200
    assert client.post(f"{address}&number=6", json=project(LIGHT)).status_code == 204
    assert client.post(f"api/photos/{photo}/preview?page=q&number=1", json=project(LIGHT)).status_code == 200


def test_the_target_is_the_source_and_the_lamp(client, photo):
    def raster(answer):
        shape = [int(side) for side in answer.headers["X-Shape"].split()]
        return np.frombuffer(answer.content, "<f4").reshape(shape)

    source = raster(client.get(f"api/photos/{photo}/source"))
    target = raster(client.post(f"api/photos/{photo}/target", json=project(LIGHT)))
    inside = target[..., 3] > 0
    assert 0 < inside.mean() < 0.5
    assert (target[..., :3][inside] >= source[inside] - 1e-6).all()


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[]", json.dumps({**project(LIGHT), "version": 9}).encode(), b'{"a": NaN}', b"[" * 100_000],
)
def test_a_project_that_makes_no_sense_is_one_sentence(client, photo, body):
    answer = client.post(f"api/photos/{photo}/preview", content=body)
    assert answer.status_code == 400 and answer.json()["error"].startswith("Cannot read project.json: ")


def test_a_project_of_another_photo_is_refused(client, photo):
    answer = client.post(f"api/photos/{photo}/preview", json=project(LIGHT, size=(100, 100)))
    assert answer.status_code == 422 and "100 x 100" in answer.json()["error"]


# Results


def test_the_export_is_the_file_that_the_command_line_writes(
    client, photo, photo_file, mini_bundle, tmp_path
):
    flag = {**LIGHT, "blend": "multiply", "reach": None, "strength": 0.3}
    wanted = project(LIGHT, flag, steps=3)
    job = relit(client, photo, wanted)
    saved = tmp_path / "scene.dior"
    saved.write_bytes(client.post("api/projects/pack", json=wanted).content)
    for kind, suffix in (("png", ".png"), ("tiff", ".tif"), ("jpeg", ".jpg"), ("webp", ".webp")):
        out = tmp_path / f"out{suffix}"
        model = ["--bundle", str(mini_bundle), "--device", "cpu", "--ops", "numpy"]
        assert run(["relight", str(photo_file), str(saved), "-o", str(out), *model]) == 0
        assert client.get(f"api/jobs/{job}/file?kind={kind}").content == out.read_bytes()


def test_a_deep_photo_keeps_its_16_bits(client, tmp_path):
    import tifffile

    rng = np.random.default_rng(0)
    deep = np.repeat(np.repeat(rng.integers(9000, 40000, (8, 12, 3), np.uint16), 8, 0), 8, 1)
    tifffile.imwrite(tmp_path / "deep.tif", deep)
    opened = client.post("api/photos?name=deep.tif", content=(tmp_path / "deep.tif").read_bytes()).json()
    assert opened["bits"] == 16
    stroke = {**STROKE, "points": [[20, 20], [60, 30]], "width": 20}
    job = relit(client, opened["id"], project({**LIGHT, "shapes": [stroke]}, size=(96, 64)))
    (tmp_path / "out.tif").write_bytes(client.get(f"api/jobs/{job}/file?kind=tiff").content)
    out = tifffile.imread(tmp_path / "out.tif")
    assert out.dtype == np.uint16 and out[:32].mean() > deep[:32].mean()


def test_a_float_photo_is_shown_and_lit(client, tmp_path):
    import OpenEXR

    light = np.full((40, 60, 3), 0.2, np.float32)
    light[:10] = 3
    OpenEXR.File({}, {"RGB": light}).write(str(tmp_path / "bright.exr"))
    shown = client.post("api/photos?name=bright.exr", content=(tmp_path / "bright.exr").read_bytes()).json()
    assert shown["bits"] == 32
    assert pixels(client.get(f"api/photos/{shown['id']}/picture"))[2, 2].min() >= 254
    wanted = project(
        {**LIGHT, "reach": None, "shapes": [{**STROKE, "points": [[20, 30], [40, 30]]}]},
        steps=1,
        size=(60, 40),
    )
    job = relit(client, shown["id"], wanted)
    assert pixels(client.get(f"api/jobs/{job}/picture")).shape == (40, 60, 3)
    assert client.post(f"api/photos/{shown['id']}/layers?kind=ora", json=wanted).status_code == 200


def test_lights_are_layers_for_other_programs(client, photo, tmp_path):
    lights = project(LIGHT, {**LIGHT, "name": "Flag <&> 2", "blend": "multiply", "on": False})
    ora = client.post(f"api/photos/{photo}/layers?kind=ora", json=lights).content
    with zipfile.ZipFile(io.BytesIO(ora)) as archive:
        first = archive.infolist()[0]
        assert (first.filename, first.compress_type) == ("mimetype", zipfile.ZIP_STORED)
        assert archive.read("mimetype") == b"image/openraster"
        import xml.etree.ElementTree as ET

        layers = ET.fromstring(archive.read("stack.xml")).findall("stack/layer")
        assert [layer.get("name") for layer in layers] == ["Flag <&> 2", "Key", "Photo"]
        assert [layer.get("composite-op") for layer in layers[:2]] == ["svg:multiply", "svg:plus"]
        assert layers[0].get("visibility") == "hidden"
        key = Image.open(io.BytesIO(archive.read(layers[1].get("src"))))
        assert key.size == (480, 320) and key.getpixel((160, 120))[3] > 200 > 0 == key.getpixel((470, 10))[3]
    (tmp_path / "lights.exr").write_bytes(
        client.post(f"api/photos/{photo}/layers?kind=exr", json=lights).content
    )
    import OpenEXR

    channels = OpenEXR.File(str(tmp_path / "lights.exr"), separate_channels=True).channels()
    assert channels["01_key_add.R"].pixels.max() == pytest.approx(3, rel=0.02)
    pngs = client.post(f"api/photos/{photo}/layers?kind=png", json=lights).content
    with zipfile.ZipFile(io.BytesIO(pngs)) as archive:
        assert archive.namelist() == ["01-key-add.png", "02-flag-2-multiply.png"]
    assert client.post(f"api/photos/{photo}/layers?kind=png", json=project()).status_code == 422


def test_a_project_goes_through_its_file(client):
    wanted = project(LIGHT)
    packed = client.post("api/projects/pack", json=wanted).content
    assert unpack(packed).lights[0].name == "Key"
    assert client.post("api/projects/unpack", content=packed).json() == wanted
    broken = client.post("api/projects/unpack", content=packed[:-40])
    assert broken.status_code == 400 and broken.json()["error"].startswith("Cannot read the project: ")


# The queue


def test_jobs_run_one_at_a_time_in_order_and_say_how_many_are_ahead():
    queue, gate, order = Queue(), threading.Event(), []

    def work(name):
        def run(job):
            order.append(name)
            gate.wait(10)
            return name

        return run

    jobs = [queue.submit(work(name)) for name in "abc"]
    assert [job.state.ahead for job in jobs] == [0, 1, 2]
    gate.set()
    assert [[*job.states()][-1].stage for job in jobs] == ["done"] * 3
    assert order == ["a", "b", "c"] and [job.result for job in jobs] == ["a", "b", "c"]
    queue.close()


def test_a_job_is_cancelled_while_it_runs_and_while_it_waits():
    queue, started = Queue(), threading.Event()

    def slow(job):
        started.set()
        for step in range(10_000):
            if not job.progress(step, 10_000):
                raise Cancelled("stopped")
            threading.Event().wait(0.001)

    running, waiting = queue.submit(slow), queue.submit(slow)
    started.wait(10)
    waiting.cancel()
    running.cancel()
    assert [[*job.states()][-1].stage for job in (running, waiting)] == ["cancelled", "cancelled"]
    assert running.state.stage == "cancelled" and waiting.state.steps == 0
    queue.close()


def test_what_goes_wrong_is_the_jobs_message_and_too_many_jobs_are_refused():
    queue, gate = Queue(waiting=1), threading.Event()

    def fail(job):
        gate.wait(10)
        raise InputError("The light is too strong.")

    jobs = [queue.submit(fail) for _ in range(3)]
    assert jobs[2] is None
    gate.set()
    state = [*jobs[0].states()][-1]
    assert (state.stage, state.message) == ("failed", "The light is too strong.")
    queue.close()


# The command


def test_the_command_prints_a_link_and_leaves_nothing_behind(photo_file, tmp_path):
    import os
    import re
    import signal

    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    command = [sys.executable, "-m", "dior_rt", "desk", str(photo_file), "--no-browser", "--port", "0"]
    root = Path(__file__).parents[2]
    desk = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=root)
    try:
        link = re.search(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", desk.stdout.readline())[0]
        assert httpx.get(f"{link}api/desk", timeout=60).json()["photo"] == "scene.png"
        assert list(tmp_path.glob("dior-desk-*"))
    finally:
        desk.send_signal(signal.SIGINT)
        assert desk.wait(30) == 0
    assert not list(tmp_path.glob("dior-desk-*"))


def test_a_port_that_is_taken_is_one_sentence(desk):
    port = desk.host.rpartition(":")[2]
    command = [sys.executable, "-m", "dior_rt", "desk", "--no-browser", "--port", port]
    refused = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert refused.returncode == 2
    assert refused.stderr.startswith(f"dior-rt: Cannot listen on port {port}: ")
