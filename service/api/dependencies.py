"""What routes ask for, taken from the running app: nothing here is built at import.

All are coroutines, though they wait for nothing: FastAPI gives each plain function a thread, which costs more.
"""

from collections.abc import AsyncIterator
from typing import Annotated, get_origin

from fastapi import Depends, Header, Request, params
from fastapi.dependencies.utils import get_flat_params
from pydantic import Field

from service.api.clients import Followers
from service.api.problems import invalid_request
from service.api.texts import Worded
from service.config import Settings
from service.errors import BadRequest, UnsupportedKind
from service.inference.artifact import ModelFolder
from service.inference.estimator import Estimator
from service.inference.worker import Worker
from service.principal import Principal
from service.runner import Runner
from service.storage.calibrations import Calibrations
from service.storage.cameras import Cameras
from service.storage.spool import Spool

MOST_PARAMETERS = 1_200  # more than all that any route takes, its lists filled


def _of_app(name: str) -> params.Depends:
    """A part of the running app, by its name in the app's state."""

    async def get(request: Request) -> object:
        part: object = getattr(request.app.state, name)
        return part

    return params.Depends(get)


SettingsDep = Annotated[Settings, _of_app("settings")]
ModelDep = Annotated[ModelFolder, _of_app("model")]
EstimatorDep = Annotated[Estimator, _of_app("estimator")]
SpoolDep = Annotated[Spool, _of_app("spool")]
RunnerDep = Annotated[Runner, _of_app("runner")]
FollowersDep = Annotated[Followers, _of_app("followers")]


async def get_owner(request: Request) -> str:
    principal: Principal = request.state.principal
    return principal.owner


async def get_sharer(request: Request) -> str | None:
    principal: Principal = request.state.principal
    return principal.sharer


OwnerDep = Annotated[str, Depends(get_owner)]
SharerDep = Annotated[str | None, Depends(get_sharer)]


async def get_worker(request: Request, sharer: SharerDep) -> Worker:
    """The worker, while it has room: a full queue is told before a photograph is received. Raises ``Busy``."""
    worker: Worker = request.app.state.worker
    worker.require_room(sharer)
    return worker


async def get_cameras(request: Request, owner: OwnerDep) -> Cameras:
    return Cameras(request.app.state.engine, owner)


async def get_calibrations(request: Request, owner: OwnerDep) -> Calibrations:
    return Calibrations(request.app.state.engine, owner)


WorkerDep = Annotated[Worker, Depends(get_worker)]
CamerasDep = Annotated[Cameras, Depends(get_cameras)]
CalibrationsDep = Annotated[Calibrations, Depends(get_calibrations)]


async def count_follower(owner: OwnerDep, followers: FollowersDep) -> AsyncIterator[None]:
    """Count the request until its answer is whole. Raises ``Busy``."""
    with followers.counted(owner):
        yield


async def require_known_parameters(request: Request) -> None:
    """Refuse what the query has and the route does not know, all but lists that come more than once, and too many."""
    names = [name for name, _ in request.query_params.multi_items()]
    if not names:
        return
    if len(names) > MOST_PARAMETERS:  # a fault found in each would hold up everybody for half a second
        raise BadRequest(f"A query may have at most {MOST_PARAMETERS} parameters, not {len(names)}: send fewer.")
    is_list = {
        field.alias: get_origin(field.field_info.annotation) in (list, tuple)
        for field in get_flat_params(request.scope["route"].dependant)
        if not isinstance(field.field_info, params.Path | params.Header)
    }
    faults = [
        {"type": "repeated" if name in is_list else "extra_forbidden", "loc": ("query", name), "msg": "send this once"}
        for name in dict.fromkeys(names)
        if name not in is_list or (names.count(name) > 1 and not is_list[name])
    ]
    if faults:
        raise invalid_request(faults)


async def require_json(request: Request) -> None:
    """Refuse a body that does not say it is JSON; an empty one is left to validation."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    is_json = kind == "application/json" or (kind.startswith("application/") and kind.endswith("+json"))
    if not is_json and (kind or await request.body()):
        raise UnsupportedKind(f"Send JSON with the header Content-Type: application/json, not {kind or 'none'}.")


IdempotencyKey = Annotated[
    Annotated[
        str,
        Field(min_length=1, max_length=255),
        Worded(r"^[!-~]+$", "a key has ASCII letters, digits and punctuation, and no spaces"),
    ]
    | None,
    Header(
        description="Any text, new for every new request: the same request sent again with it is done once (for a day)",
    ),
]
