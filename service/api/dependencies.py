"""What routes ask for, taken from the running app: nothing here is built at import.

All are coroutines, though they wait for nothing: FastAPI gives each plain function a thread, which costs more.
"""

from typing import Annotated

from fastapi import Depends, Header, Request

from service.api.metrics import Metrics
from service.api.texts import Worded
from service.config import Settings
from service.errors import UnsupportedKind
from service.inference.artifact import ModelFolder
from service.inference.estimator import Estimator
from service.inference.worker import Worker
from service.principal import Principal
from service.runner import Runner
from service.storage.calibrations import Calibrations
from service.storage.cameras import Cameras
from service.storage.spool import Spool


async def get_settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


async def get_owner(request: Request) -> str:
    principal: Principal = request.state.principal
    return principal.owner


async def get_cameras(request: Request, owner: Annotated[str, Depends(get_owner)]) -> Cameras:
    return Cameras(request.app.state.engine, owner)


async def get_model(request: Request) -> ModelFolder:
    model: ModelFolder = request.app.state.model
    return model


async def get_estimator(request: Request) -> Estimator:
    estimator: Estimator = request.app.state.estimator
    return estimator


async def get_worker(request: Request) -> Worker:
    worker: Worker = request.app.state.worker
    return worker


async def get_calibrations(request: Request, owner: Annotated[str, Depends(get_owner)]) -> Calibrations:
    return Calibrations(request.app.state.engine, owner)


async def get_spool(request: Request) -> Spool:
    spool: Spool = request.app.state.spool
    return spool


async def get_runner(request: Request) -> Runner:
    runner: Runner = request.app.state.runner
    return runner


async def get_metrics(request: Request) -> Metrics:
    metrics: Metrics = request.app.state.metrics
    return metrics


async def require_json(request: Request) -> None:
    """Refuse a body that does not say it is JSON; an empty one is left to validation."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    is_json = kind == "application/json" or (kind.startswith("application/") and kind.endswith("+json"))
    if not is_json and (kind or await request.body()):
        raise UnsupportedKind(f"Send application/json, not {kind or 'a body without Content-Type'}.")


IdempotencyKey = Annotated[
    Annotated[str, Worded(r"^[!-~]+$", "a key has letters, digits and signs of ASCII, and no spaces")] | None,
    Header(
        min_length=1,
        max_length=255,
        description="Any text, new for every new request: the same request sent again with it is done once (for a day)",
    ),
]
SettingsDep = Annotated[Settings, Depends(get_settings)]
CamerasDep = Annotated[Cameras, Depends(get_cameras)]
ModelDep = Annotated[ModelFolder, Depends(get_model)]
EstimatorDep = Annotated[Estimator, Depends(get_estimator)]
WorkerDep = Annotated[Worker, Depends(get_worker)]
CalibrationsDep = Annotated[Calibrations, Depends(get_calibrations)]
SpoolDep = Annotated[Spool, Depends(get_spool)]
RunnerDep = Annotated[Runner, Depends(get_runner)]
MetricsDep = Annotated[Metrics, Depends(get_metrics)]
