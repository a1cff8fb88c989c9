"""The dashboard's server: the static page, its configuration, recordings, and jobs. It does not move the vehicle.

The page gets live data from the broker, over MQTT websockets; commands go the same way to the daemon's command layer.
The steps of a commissioning are carried out by jobs, which pass their result to the daemon by its control socket; an
experiment of a step has been run by the page before, which holds its lease.
The server is for the local machine only. Requests for another host name or from another page are refused, requests that
change something need a token (`service.dashboard.guard`), and the page loads nothing from elsewhere.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from upright.estimators.identify.table import METHODS
from upright.models import library
from upright.models.effects.catalogue import CATALOGUE
from upright.models.place import places_of
from upright.service.control import assembly
from upright.service.dashboard.guard import Guard, has_token, new_token
from upright.service.dashboard.jobs import Jobs
from upright.service.dashboard.recordings import Folder, UnknownRecording, own_file
from upright.telemetry.documents import from_json
from upright.telemetry.errors import UprightError
from upright.vehicles import commissioning, registry
from upright.vehicles.file import VehicleFile

STATIC = Path(__file__).with_name("static")
SHORTEST_REASON, LONGEST_REASON = 3, 500
"""Characters of the reason why a step is skipped."""


@dataclass(frozen=True, slots=True)
class Settings:
    """The page's connections and the folder of the recordings.

    `websocket` is the broker's, ws://HOST:PORT; `socket` is the daemon's control socket, by default the usual one.
    `password` is given to pages with the `token` only.
    """

    vehicle: VehicleFile
    data: Path
    websocket: str
    user: str = ""
    password: str = field(default="", repr=False)
    host: str = "127.0.0.1"
    socket: Path | None = None
    token: str = field(default_factory=new_token, repr=False)


class Dashboard:
    """The application, as `app`."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._folder = Folder(settings.data)
        self._jobs = Jobs()
        self._models = self._folder.path / "models"
        self._reports = self._folder.path / "reports"
        self._commissioning = self._folder.path / "commissioning"
        routes = [
            Route("/api/config", self._config),
            Route("/api/recordings", self._list),
            Route("/api/recordings/{name}", self._open),
            Route("/api/recordings/{name}/{what}", self._download),
            Route("/api/model", self._model),
            Route("/api/jobs", self._start, methods=["POST"]),
            Route("/api/jobs/{number:int}", self._job, methods=["GET", "DELETE"]),
            Route("/reports/{name}", self._report),
            Route("/commissioning/{name}", self._commissioning_page),
            Mount("/", StaticFiles(directory=STATIC, html=True)),
        ]
        self.app = Starlette(
            routes=routes,
            lifespan=self._lifespan,
            middleware=[
                Middleware(Guard, policy=_policy(settings.websocket), token=settings.token),
            ],
            exception_handlers={
                UnknownRecording: _refuse(404),
                UprightError: _refuse(422),
                HTTPException: _as_json,
            },
        )

    @contextlib.asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        yield
        await self._jobs.close()

    async def _config(self, request: Request) -> Response:
        vehicle, settings = self._settings.vehicle, self._settings
        views, table = registry.of(vehicle.vehicle.kind).views, registry.recorded(vehicle)
        trusted = has_token(request.headers, settings.token)
        return JSONResponse({
            "vehicle": vehicle.vehicle.id,
            "description": vehicle.vehicle.description,
            "kind": vehicle.vehicle.kind,
            "version": assembly.version(),
            "websocket": settings.websocket,
            "topic": f"{vehicle.mqtt.base}/{vehicle.vehicle.id}",
            "user": settings.user,
            "password": settings.password if trusted else "",
            "trusted": trusted,
            "lease": vehicle.control.lease,
            "rate": vehicle.control.rate,
            "support_deg": vehicle.limits.support_deg,
            "limits": [
                {"name": views.limits[key][0], "value": value, "unit": views.limits[key][1]}
                for key, value in vehicle.limits.model_dump().items()
            ],
            "units": {channel.name: channel.unit for channel in table},
            "amplitude_unit": views.amplitude,
            "parameters": {
                name: getattr(vehicle.parameters, name).model_dump() for name in vehicle.parameters.values
            },
            "experiments": {
                name: each.model_dump(exclude_none=True) for name, each in vehicle.experiments.items()
            },
            "methods": list(METHODS),
            "charts": [
                asdict(chart) for chart in views.charts if all(curve.channel in table.names for curve in chart.curves)
            ],
        })  # fmt: skip

    async def _list(self, request: Request) -> Response:
        return JSONResponse({"recordings": await asyncio.to_thread(self._folder.list)})

    async def _open(self, request: Request) -> Response:
        points = request.query_params.get("points", "1500")
        most = int(points) if points.isdecimal() and len(points) < 6 else 1500
        return JSONResponse(await asyncio.to_thread(self._folder.open, request.path_params["name"], most))

    async def _download(self, request: Request) -> Response:
        path = await asyncio.to_thread(self._folder.download, request.path_params["name"], request.path_params["what"])
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    async def _model(self, request: Request) -> Response:
        """The model file that effects are added to, with its effects and history; null if there is none yet."""
        return JSONResponse({"model": await asyncio.to_thread(self._read_model)})

    def _read_model(self) -> dict[str, Any] | None:
        from upright.models.file.model_file import read

        if not self._model_file.is_file():
            return None
        file = read(self._model_file)
        return {
            "file": str(self._model_file),
            "effects": [each.name for each in file.model.effects],
            "history": [{key: str(value) for key, value in entry.items()} for entry in file.history],
        }

    @property
    def _model_file(self) -> Path:
        return self._models / f"{self._settings.vehicle.vehicle.id}.toml"

    async def _start(self, request: Request) -> Response:
        try:
            document = from_json(await request.body())
        except ValueError:
            raise HTTPException(400, "not JSON") from None
        if not isinstance(document, dict):
            raise HTTPException(400, "not an object")
        kind = document.get("kind")
        words = await asyncio.to_thread(self._words, kind, document)
        return JSONResponse(self._jobs.start(str(kind), words).to_json(), 202)

    def _words(self, kind: object, document: dict[str, Any]) -> list[str]:
        """The command line of a job. Values from outside are looked up, never passed on directly."""
        if kind in ("commission", "skip", "begin"):
            return self._commission(kind, document)
        vehicle = self._vehicle
        names = document.get("recordings", [])
        if not isinstance(names, list) or not 0 < len(names) <= 8:
            if kind != "undo":
                raise HTTPException(400, "give one to eight recordings")
            names = []
        paths = [str(self._folder.find(str(name))) for name in names]
        base, own = assembly_model(self._settings.vehicle), self._model_file
        match kind:
            case "compare":
                return ["compare", *paths, *vehicle, *(["--model", str(own)] if own.is_file() else [])]
            case "identify":
                methods = document.get("methods", [])
                if not isinstance(methods, list) or not {str(each) for each in methods} <= METHODS.keys():
                    raise HTTPException(400, "no such method")
                return ["identify", *paths, *vehicle, *(word for each in methods for word in ("--method", str(each)))]
            case "diagnose" | "report":
                words = ["diagnose", *paths, *vehicle, *(["--model", str(own)] if own.is_file() else [])]
                self._reports.mkdir(parents=True, exist_ok=True)
                return [*words, "--report", str(self._reports / f"{Path(paths[0]).stem}.html")]
            case "add":
                effect, _, place = str(document.get("effect")).partition("@")
                if effect not in CATALOGUE:
                    raise HTTPException(400, "not an effect of the catalogue")
                there = places_of(library.get(base), CATALOGUE[effect].place)
                if place and place not in {each.name for each in there}:
                    raise HTTPException(400, "the model has no such place")
                self._models.mkdir(parents=True, exist_ok=True)
                start = [str(own)] if own.is_file() else [base]
                output = [] if own.is_file() else ["--output", str(own)]
                recordings = [word for path in paths for word in ("--recording", path)]
                at = ["--at", place] if place else []
                return ["model", "add", *start, effect, *at, *recordings, *vehicle, *output]
            case "undo" if own.is_file():
                return ["model", "undo", str(own)]
        raise HTTPException(400, "no such job")

    def _commission(self, kind: object, document: dict[str, Any]) -> list[str]:
        """The command line of a step. Its experiment has been run before: a job never moves the vehicle."""
        socket = ["--socket", str(self._settings.socket.absolute())] if self._settings.socket is not None else []
        daemon = [*self._vehicle, *socket]
        steps = commissioning.steps_for(self._settings.vehicle)
        if kind == "begin":
            return ["commission", "--begin", *daemon]
        step = steps.find(str(document.get("step")))
        if kind == "skip":
            return ["commission", "--skip", step.id, f"--reason={_reason(document.get('reason'))}", *daemon]
        name = document.get("recording")
        if (name is None) == bool(step.experiment):
            raise HTTPException(400, f"step {step.id} has {'an' if step.experiment else 'no'} experiment to evaluate")
        recording = [] if name is None else ["--recording", str(self._folder.find(str(name)))]
        return ["commission", "--step", step.id, *recording, "--yes", *daemon]

    @property
    def _vehicle(self) -> list[str]:
        return ["--vehicle", self._settings.vehicle.path or self._settings.vehicle.vehicle.id]

    async def _job(self, request: Request) -> Response:
        job = self._jobs.find(request.path_params["number"])
        if job is None:
            raise HTTPException(404, "no such job")
        if request.method == "DELETE":
            self._jobs.cancel(job)
        return JSONResponse(job.to_json())

    async def _report(self, request: Request) -> Response:
        return _report_of(self._reports, request.path_params["name"])

    async def _commissioning_page(self, request: Request) -> Response:
        return _report_of(self._commissioning, request.path_params["name"])


REPORT = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'none'"


def _report_of(folder: Path, name: str) -> Response:
    """A report as a separate page, in which no script can run."""
    there = [each.name for each in folder.iterdir() if own_file(each)] if folder.is_dir() else []
    if name not in there or not name.endswith(".html"):
        raise HTTPException(404, "no such report")
    return FileResponse(folder / name, media_type="text/html", headers={"content-security-policy": REPORT})


def _reason(words: object) -> str:
    """The reason of a person, on one line."""
    reason = " ".join(words.split()) if isinstance(words, str) else ""
    if not (SHORTEST_REASON <= len(reason) <= LONGEST_REASON and reason.isprintable()):
        raise HTTPException(400, f"a reason has {SHORTEST_REASON} to {LONGEST_REASON} characters")
    return reason


def assembly_model(vehicle: VehicleFile) -> str:
    """The shipped model that a vehicle of this kind starts from."""
    return registry.nominal_model(vehicle.vehicle.kind).name


def _policy(websocket: str) -> str:
    place = urlsplit(websocket)
    return (
        f"default-src 'self'; connect-src 'self' {place.scheme}://{place.netloc}; img-src 'self' data:;"
        " object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )


def _refuse(status: int) -> Callable[[Request, Exception], Awaitable[Response]]:
    async def refuse(request: Request, error: Exception) -> Response:
        return JSONResponse({"error": str(error)}, status)

    return refuse


async def _as_json(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return JSONResponse({"error": error.detail}, error.status_code)
