"""The studio over HTTP: the page's files, and the requests of the page. Errors are {"error": sentence}."""

from __future__ import annotations

import json
import secrets
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np
from fastapi import FastAPI, HTTPException, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse, Response, StreamingResponse
from numpy.typing import NDArray

from dior_rt import __version__
from dior_rt.desk.guard import Guard
from dior_rt.desk.jobs import Job
from dior_rt.desk.layers import LAYER_FORMATS, write_layers
from dior_rt.desk.studio import MOST_PREVIEW, Result, Shown, Studio, encode_jpeg, shrink
from dior_rt.errors import Cancelled, DiorError
from dior_rt.project import ENTRY, MOST_BYTES, Project, pack, parse_project, unpack
from dior_rt.records import loads

MOST_PHOTO_BYTES: Final = 512 << 20

FORMATS: Final = {
    "png": ("image/png", ".png"),
    "tiff": ("image/tiff", ".tif"),
    "jpeg": ("image/jpeg", ".jpg"),
    "webp": ("image/webp", ".webp"),
}

TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}


def make_app(studio: Studio, token: str, hosts: frozenset[str], first: Path | None = None) -> FastAPI:
    """Return the application. first: a photo to put on the desk when the page asks for it."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        yield
        await run_in_threadpool(studio.close)

    app = FastAPI(title="The light desk", openapi_url=None, docs_url=None, redoc_url=None, lifespan=lifespan)
    app.add_middleware(Guard, token=token, hosts=hosts)  # type: ignore[arg-type]
    app.add_exception_handler(DiorError, _answer_error)
    app.add_exception_handler(HTTPException, _answer_http_error)
    _add_page(app)
    _add_photos(app, studio, first)
    _add_light(app, studio)
    _add_jobs(app, studio)
    _add_projects(app, studio)
    return app


def _add_page(app: FastAPI) -> None:
    page = {file.name: file.read_bytes() for file in files("dior_rt.desk").joinpath("page").iterdir()}

    @app.get("/{name}")
    def file(name: str) -> Response:
        kind = TYPES.get(Path(name).suffix)
        if kind is None or name not in page:
            raise HTTPException(404, "There is no such file.")
        return Response(page[name], media_type=kind)

    @app.get("/")
    def index() -> Response:
        return file("index.html")


def _add_photos(app: FastAPI, studio: Studio, first: Path | None) -> None:
    @app.get("/api/desk")
    def desk() -> dict[str, Any]:
        """Return the data that the page needs at its start. Waits for the model."""
        relighter = studio.relighter
        return {
            "version": __version__,
            "model": relighter.bundle.manifest.name,
            "device": relighter.device,
            "device_reason": relighter.device_reason,
            "ops": relighter.ops,
            "presets": relighter.presets,
            "steps": relighter.bundle.manifest.steps,
            "most_bytes": MOST_PHOTO_BYTES,
            "most_preview": MOST_PREVIEW,
            "photo": first.name if first else None,
        }

    @app.post("/api/photos/first")
    def open_first() -> dict[str, Any]:
        """Put the photo of the command line on the desk."""
        if first is None:
            raise HTTPException(404, "The desk was opened without a photo.")
        return _describe(studio.open(first, first.name))

    @app.post("/api/photos")
    async def open_photo(request: Request, name: str = "photo") -> dict[str, Any]:
        """Put the photo in the body on the desk."""
        path = studio.folder / secrets.token_hex(8)
        try:
            with path.open("wb") as upload:
                async for chunk in _limited(request, MOST_PHOTO_BYTES):
                    upload.write(chunk)
            return _describe(await run_in_threadpool(studio.open, path, Path(name).name[:200] or "photo"))
        finally:
            path.unlink(missing_ok=True)

    @app.get("/api/photos/{photo}")
    def describe(photo: str) -> dict[str, Any]:
        return _describe(_photo(studio, photo))

    @app.get("/api/photos/{photo}/picture")
    def picture(photo: str, longest: int = MOST_PREVIEW) -> Response:
        """Return the photo as it is, at the size of a preview."""
        size = min(max(longest, 1), MOST_PREVIEW)
        shown = _photo(studio, photo)
        return Response(encode_jpeg(shown.open.small(size), shown.file), media_type="image/jpeg")


def _add_light(app: FastAPI, studio: Studio) -> None:
    @app.post("/api/photos/{photo}/preview")
    async def preview(
        request: Request, photo: str, page: str = "", number: int = 0, longest: int = 1024
    ) -> Response:
        """Return a JPEG of the photo under the project's lights, or 204 where the page has since asked
        again.
        """
        shown, is_newest = _photo(studio, photo), studio.newest.note(page[:64], number)
        project = await _project(request)
        size = min(max(longest, 16), MOST_PREVIEW)
        try:
            jpeg, notice = await run_in_threadpool(studio.preview, shown, project, size, is_newest)
        except Cancelled:
            return Response(status_code=204)
        return Response(jpeg, media_type="image/jpeg", headers={"X-Nothing-Drawn": "1"} if notice else None)

    @app.get("/api/photos/{photo}/source")
    def source(photo: str) -> Response:
        """Return the model's estimate of the light on the photo: float32, row by row, RGB."""
        return _raster(_photo(studio, photo).open.source_map())

    @app.post("/api/photos/{photo}/target")
    async def target(request: Request, photo: str) -> Response:
        """Return the light that the project's lights ask for, on the light grid: float32, row by row, RGB and
        the mask.
        """
        shown, project = _photo(studio, photo), await _project(request)
        asked = await run_in_threadpool(studio.target, shown, project)
        return _raster(np.dstack([asked.light, asked.mask]))


def _add_jobs(app: FastAPI, studio: Studio) -> None:
    @app.post("/api/photos/{photo}/jobs", status_code=202)
    async def relight(request: Request, photo: str) -> dict[str, str]:
        """Queue the full result of a project."""
        shown, project = _photo(studio, photo), await _project(request)
        job = studio.relight(shown, project)
        if job is None:
            raise HTTPException(429, "Too many results are waiting; cancel one or try again in a moment.")
        return {"job": job.id}

    @app.get("/api/jobs/{job}/events")
    def events(job: str) -> StreamingResponse:
        """Stream the job's states as server-sent events, until it is over."""
        states = _job(studio, job).states()

        def stream() -> Iterator[str]:
            for state in states:
                yield f"data: {json.dumps(asdict(state))}\n\n" if state else ": still here\n\n"

        return StreamingResponse(stream(), media_type="text/event-stream")

    @app.delete("/api/jobs/{job}", status_code=204)
    def cancel(job: str) -> None:
        _job(studio, job).cancel()

    @app.get("/api/jobs/{job}/picture")
    def picture(job: str, longest: int = MOST_PREVIEW) -> Response:
        """Return the result at the size of a preview."""
        relit = _result(studio, job).photo
        pixels = shrink(relit, min(max(longest, 16), MOST_PREVIEW))
        return Response(encode_jpeg(pixels, relit), media_type="image/jpeg")

    @app.get("/api/jobs/{job}/file")
    def export(job: str, kind: str = "png") -> Response:
        """Return the file that `dior-rt relight` would write for the project."""
        if kind not in FORMATS:
            raise HTTPException(400, f"The format must be one of {', '.join(FORMATS)}.")
        media_type, suffix = FORMATS[kind]
        return Response(studio.export(_result(studio, job), suffix), media_type=media_type)


def _add_projects(app: FastAPI, studio: Studio) -> None:
    @app.post("/api/projects/pack")
    async def pack_project(request: Request) -> Response:
        """Return a project as a file."""
        return Response(pack(await _project(request)), media_type="application/zip")

    @app.post("/api/projects/unpack")
    async def unpack_project(request: Request) -> Response:
        """Return the project in a file, as JSON."""
        data = await _body(request, MOST_BYTES)
        try:
            project = unpack(data)
        except ValueError as error:
            raise HTTPException(400, f"Cannot read the project: {error}.") from error
        return Response(json.dumps(asdict(project)), media_type="application/json")

    @app.post("/api/photos/{photo}/layers")
    async def layers(request: Request, photo: str, kind: str = "ora") -> Response:
        """Return the lights as layers for other programs."""
        if kind not in LAYER_FORMATS:
            raise HTTPException(400, f"The format must be one of {', '.join(LAYER_FORMATS)}.")
        shown, project = _photo(studio, photo), await _project(request)
        data = await run_in_threadpool(write_layers, shown.file, shown.lights(project), kind, studio.folder)
        return Response(data, media_type=LAYER_FORMATS[kind])


def _describe(shown: Shown) -> dict[str, Any]:
    height, width = shown.file.size
    return {
        "id": shown.id,
        "name": shown.name,
        "size": [width, height],
        "bits": shown.file.bits,
        "transparent": shown.file.alpha is not None,
        "notices": shown.file.notices,
    }


def _photo(studio: Studio, name: str) -> Shown:
    shown = studio.photo(name)
    if shown is None:
        raise HTTPException(404, "This photo is no longer on the desk; open it again.")
    return shown


def _job(studio: Studio, name: str) -> Job:
    job = studio.queue.get(name)
    if job is None:
        raise HTTPException(404, "This result is no longer here; relight again.")
    return job


def _result(studio: Studio, name: str) -> Result:
    result = _job(studio, name).result
    if result is None:
        raise HTTPException(409, "This result is not ready.")
    return result


def _raster(array: NDArray) -> Response:
    rows, columns, channels = array.shape
    shape = {"X-Shape": f"{rows} {columns} {channels}"}
    return Response(array.astype("<f4").tobytes(), media_type="application/octet-stream", headers=shape)


async def _project(request: Request) -> Project:
    data = await _body(request, MOST_BYTES)
    try:
        return await run_in_threadpool(lambda: parse_project(loads(data)))
    except ValueError as error:
        raise HTTPException(400, f"Cannot read {ENTRY}: {error}.") from error


async def _body(request: Request, most: int) -> bytes:
    return b"".join([chunk async for chunk in _limited(request, most)])


async def _limited(request: Request, most: int) -> AsyncIterator[bytes]:
    """Yield the body's parts.

    Raises 413 as soon as the body is, or declares that it will be, longer than `most` bytes.
    """
    announced = request.headers.get("content-length", "0")
    seen = int(announced) if announced.isdigit() else 0
    if seen <= most:
        seen = 0
        async for chunk in request.stream():
            seen += len(chunk)
            if seen > most:
                break
            yield chunk
    if seen > most:
        raise HTTPException(413, f"That is more than {most >> 20} MiB.")


def _answer_error(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"error": str(error)}, 422)


def _answer_http_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)
