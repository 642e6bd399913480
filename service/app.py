"""The app: routes and middleware at once; database, model and worker only when it starts."""

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from importlib.metadata import version
from typing import Any

from fastapi import Depends, FastAPI
from fastapi_offline import FastAPIOffline

from service.access import AllowOrigins, Authenticate
from service.api import (
    calibrations,
    cameras,
    depth,
    handlers,
    health,
    look,
    metrics,
    model,
    openapi,
    page,
    photographs,
    target,
)
from service.api.clients import Followers
from service.api.dependencies import require_known_parameters
from service.api.problems import responses
from service.api.uploads import Arrivals
from service.calibration.report import Report
from service.calibration.task import Picture, Task, Tell
from service.compression import Compress
from service.config import Settings
from service.errors import BadRequest
from service.inference.artifact import load_model_folder
from service.inference.estimator import Estimator
from service.inference.images import ImageLimits
from service.inference.worker import Worker
from service.middleware import AnswerHead, BodyLimits, LimitRequests, ObserveRequests
from service.runner import Calibrate, Runner
from service.storage import backup, schema
from service.storage.calibrations import Calibrations
from service.storage.engine import open_engine
from service.storage.keys import Keys
from service.storage.spool import Spool
from service.tracing import Tracing

PHOTOGRAPH_PATHS = ("/depth", "/cameras/from-photo", "/calibrate/look", "/photographs/preview")
CALIBRATE_PATH = "/calibrate"
DESCRIPTION = """\
How far away is each pixel of this single photograph, in metres, given the camera that took it?
Register a camera once, from its k_cam or its lens specs, and send photographs: no training is needed.
Every error is `application/problem+json`.
"""
TAGS = [
    {"name": "cameras", "description": "What turns blur into metres"},
    {"name": "depth", "description": "Photographs to depth maps"},
    {"name": "calibration", "description": "A camera's constants from a sheet of paper"},
    {"name": "service", "description": "The model, health and metrics"},
]


def calibrate(task: Task, pictures: Sequence[Picture], tell: Tell, check: Callable[[], None]) -> Report:
    """``service.calibration.calibrate.calibrate``, which loads SciPy: most starts are not for a calibration."""
    from service.calibration.calibrate import calibrate

    return calibrate(task, pictures, tell, check)


def create_app(settings: Settings, calibrate: Calibrate = calibrate) -> FastAPI:
    """The app for these settings; nothing is opened or loaded before it starts.

    Raises ``SettingsError`` where they ask for traces and the extra ``otel`` is missing.
    """
    app = FastAPIOffline(
        title="camind",
        version=version("camind"),
        summary="Metres from one photograph, for any camera",
        description=DESCRIPTION,
        openapi_tags=TAGS,
        license_info={"name": "Apache-2.0", "identifier": "Apache-2.0"},
        lifespan=_lifespan,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.settings = settings
    app.state.metrics = metrics.Metrics()
    app.state.tracing = Tracing(settings.otlp_endpoint) if settings.otlp_endpoint else None
    app.state.calibrate = calibrate
    app.state.is_stopping = False
    app.state.arrivals = Arrivals((settings.worker_slots + settings.queue_size) * settings.max_image_bytes)
    app.state.followers = Followers()
    _add_middleware(app, settings)
    handlers.install(app)
    for part in (cameras, depth, photographs, calibrations, look, target):
        app.include_router(
            part.router, dependencies=[Depends(require_known_parameters)], responses=responses(BadRequest)
        )
    for part in (model, health, metrics, page):
        app.include_router(part.router)
    # FastAPI's own way to another description: https://fastapi.tiangolo.com/how-to/extending-openapi/
    replaceable: Any = app
    replaceable.openapi = partial(openapi.describe, app)
    return app


def _add_middleware(app: FastAPI, settings: Settings) -> None:
    # the last one added is the outermost
    app.add_middleware(Compress)
    photograph = BodyLimits(settings.max_image_bytes, settings.receive_deadline_s)
    app.add_middleware(
        LimitRequests,
        limits=BodyLimits(settings.max_json_bytes, settings.receive_deadline_s),
        limits_by_path={
            **dict.fromkeys(PHOTOGRAPH_PATHS, photograph),
            CALIBRATE_PATH: BodyLimits(settings.max_calibration_bytes, settings.calibration_receive_deadline_s),
        },
    )
    app.add_middleware(
        Authenticate,
        is_on=settings.wants_keys,
        requests_per_minute=settings.key_requests_per_minute,
        hosts=settings.known_hosts,
        origins=settings.known_origins,
    )
    app.add_middleware(AnswerHead)
    app.add_middleware(ObserveRequests, metrics=app.state.metrics, tracing=app.state.tracing)
    app.add_middleware(AllowOrigins, origins=settings.known_origins)


@asynccontextmanager
async def _lifespan(app: FastAPI) -> AsyncIterator[None]:
    settings: Settings = app.state.settings
    with backup.using(settings.effective_database_url):
        await asyncio.to_thread(_start, app)
        try:
            yield
        finally:
            await asyncio.to_thread(_stop, app)


def _start(app: FastAPI) -> None:
    settings: Settings = app.state.settings
    schema.head_revision()  # from here on
    engine = open_engine(settings.effective_database_url)
    if settings.is_database_embedded:
        schema.upgrade(engine)
    folder = load_model_folder(settings.served_model_dir)
    estimator = Estimator.from_folder(folder, intra_op_threads=settings.threads_per_worker)
    estimator.warm_up()
    app.state.engine = engine
    app.state.keys = Keys(engine)
    app.state.model = folder
    app.state.estimator = estimator
    app.state.worker = Worker(
        slots=settings.worker_slots,
        queue_size=settings.queue_size,
        deadline_s=settings.deadline_s,
        tell_wait=app.state.metrics.time_wait,
    )
    app.state.spool = Spool(settings.spool_dir)
    calibrations = Calibrations(engine)
    app.state.runner = Runner(
        calibrations,
        app.state.spool,
        ImageLimits.of(settings),
        app.state.calibrate,
        app.state.metrics.count_problem,
    )
    app.state.runner.start()
    if app.state.tracing is not None:
        app.state.tracing.start()
    app.state.metrics.watch(
        metrics.Parts(
            folder.manifest.name,
            app.state.worker,
            calibrations,
            app.state.spool.id,
            settings.calibration_queue_size,
        )
    )
    app.state.is_warm = True


def _stop(app: FastAPI) -> None:
    app.state.is_warm = False
    app.state.metrics.watch(None)
    app.state.runner.close()
    app.state.worker.close()
    app.state.estimator.close()
    app.state.engine.dispose()
    if app.state.tracing is not None:
        app.state.tracing.close()
