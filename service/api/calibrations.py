"""``POST /calibrate`` and ``/calibrations``: photographs of the printed grid in, a camera's constants out."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Header, Path, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import EventSourceResponse, ServerSentEvent

from service.api.calibration_intake import IntakeDep
from service.api.calibration_schemas import (
    SETTINGS_FIELD,
    Acceptance,
    CalibrationItem,
    CalibrationPage,
    CalibrationRead,
    CalibrationSettings,
)
from service.api.calibration_uploads import DEFOCUSED, FOCUSED
from service.api.camera_schemas import Name
from service.api.cursors import Cursor, Limit, cursor_after, name_of
from service.api.dependencies import (
    CalibrationsDep,
    FollowersDep,
    IdempotencyKey,
    RunnerDep,
    SpoolDep,
    count_follower,
    require_json,
)
from service.api.openapi import REF
from service.api.preferences import MOST_WAIT_S, wait_of
from service.api.problems import STORE_ERRORS, WRITE_ERRORS, responses
from service.api.uploads import BINARY, MULTIPART
from service.errors import (
    BadRequest,
    Busy,
    Conflict,
    InvalidImage,
    KeyReused,
    NotFound,
    NotReady,
    TooLarge,
    UnsupportedKind,
)
from service.inference.images import PHOTOGRAPH_TYPES
from service.runner import RESULT
from service.storage.calibrations import ID_PATTERN, CalibrationRecord, Calibrations
from service.storage.keys import Keys

LOOK_S = 0.2
HEADERS = {
    "Location": {"description": "The calibration's path", "schema": {"type": "string"}},
    "Preference-Applied": {"description": "The wait that was granted", "schema": {"type": "string"}},
}
SETTINGS_SCHEMA = {"$ref": REF.format(model=CalibrationSettings.__name__)}
FILES = {"type": "array", "items": BINARY}

router = APIRouter(tags=["calibration"])


CalibrationId = Annotated[str, Path(alias="id")]


def _find(calibration_id: CalibrationId, calibrations: CalibrationsDep) -> CalibrationRecord:
    return calibrations.get(calibration_id)


FoundDep = Annotated[CalibrationRecord, Depends(_find)]


@router.post(
    "/calibrate",
    operation_id="createCalibration",
    status_code=202,
    response_model=CalibrationRead,
    summary="Calibrate a camera from photographs of the printed grid",
    responses={
        200: {"model": CalibrationRead, "description": "It ended within the wait", "headers": HEADERS},
        202: {"description": "It is queued", "headers": HEADERS},
        **responses(BadRequest, InvalidImage, KeyReused, TooLarge, UnsupportedKind, *WRITE_ERRORS),
    },
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                MULTIPART: {
                    "schema": {
                        "type": "object",
                        "required": [SETTINGS_FIELD, DEFOCUSED],
                        "additionalProperties": False,
                        "properties": {
                            SETTINGS_FIELD: SETTINGS_SCHEMA,
                            FOCUSED: {**FILES, "description": "In focus: for the lens' geometry"},
                            DEFOCUSED: {
                                **FILES,
                                "description": "Nearer and farther than the focus; of both kinds together at least "
                                "two must show the sheet, and eight to twelve should, tilted this way and that",
                            },
                        },
                    },
                    "encoding": {
                        SETTINGS_FIELD: {"contentType": "application/json"},
                        **{role: {"contentType": ", ".join(PHOTOGRAPH_TYPES)} for role in (FOCUSED, DEFOCUSED)},
                    },
                }
            },
        }
    },
)
async def create_calibration(
    request: Request,
    response: Response,
    camera: Annotated[Name, Query(description="The camera it is for; it need not be there yet")],
    intake: IntakeDep,
    runner: RunnerDep,
    followers: FollowersDep,
    prefer: Annotated[
        str | None, Header(description=f"`wait=SECONDS`, at most {MOST_WAIT_S}: answer when it has ended")
    ] = None,
    idempotency_key: IdempotencyKey = None,
) -> CalibrationRead:
    """Queue a calibration. It is worked on one at a time, survives a restart, and its photographs go when it ends."""
    record = await intake.receive(request, camera, idempotency_key)
    runner.wake()
    response.headers["Location"] = f"/calibrations/{record.id}"
    wait_s = wait_of(prefer)
    if wait_s is not None:
        with suppress(Busy), followers.counted(intake.principal.owner):
            record = await _waited(request.app, intake.calibrations, record, wait_s)
            response.headers["Preference-Applied"] = f"wait={wait_s}"
            response.status_code = 200 if record.has_ended else 202
    return CalibrationRead.model_validate(record)


@router.get(
    "/calibrations",
    operation_id="listCalibrations",
    summary="List calibrations, the newest first",
    responses=responses(BadRequest, *STORE_ERRORS),
)
def list_calibrations(
    calibrations: CalibrationsDep,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> CalibrationPage:
    """Calibrations a page at a time, without images and results."""
    summaries, has_more = calibrations.page(limit, name_of(cursor, ID_PATTERN))
    return CalibrationPage(
        items=[CalibrationItem.model_validate(summary) for summary in summaries],
        next_cursor=cursor_after(summaries[-1].id) if has_more else None,
    )


@router.get(
    "/calibrations/{id}",
    operation_id="readCalibration",
    summary="Read a calibration",
    responses=responses(NotFound, *STORE_ERRORS),
)
def read_calibration(record: FoundDep) -> CalibrationRead:
    """How far it is, what each photograph gave, and the result or the problem at its end."""
    return CalibrationRead.model_validate(record)


@router.get(
    "/calibrations/{id}/events",
    operation_id="followCalibration",
    summary="Follow a calibration",
    response_class=EventSourceResponse,
    dependencies=[Depends(count_follower)],
    responses=responses(NotFound, *STORE_ERRORS),
)
async def follow_calibration(
    request: Request, record: FoundDep, calibrations: CalibrationsDep
) -> AsyncIterator[ServerSentEvent]:
    """The whole calibration as a server-sent event, now and after each change.

    The stream ends when the calibration has ended, or the key is good no more.
    """
    keys: Keys = request.app.state.keys
    key_id = request.state.principal.key_id
    async for now in _changes(request.app, calibrations, record):
        with suppress(Busy, NotReady):
            if key_id is not None and not await run_in_threadpool(keys.is_good, key_id):
                return
        yield ServerSentEvent(data=CalibrationRead.model_validate(now), id=str(now.version))


@router.get(
    "/calibrations/{id}/plot.svg",
    operation_id="plotCalibration",
    summary="Draw a calibration's result",
    response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}}, **responses(NotFound, Conflict, *STORE_ERRORS)},
)
def plot_calibration(record: FoundDep) -> Response:
    """The measured circles and the curve through them."""
    if record.result is None:
        raise Conflict(f"This calibration is {record.state} and has no result: only one that succeeded has a plot.")
    from service.calibration.plot import as_svg  # matplotlib is slow to import, and seldom needed

    return Response(as_svg(RESULT.validate_python(record.result)), media_type="image/svg+xml")


@router.post(
    "/calibrations/{id}/accept",
    operation_id="acceptCalibration",
    summary="Make a calibration's result a camera",
    dependencies=[Depends(require_json)],
    responses=responses(NotFound, Conflict, BadRequest, UnsupportedKind, *WRITE_ERRORS),
)
def accept_calibration(record: FoundDep, calibrations: CalibrationsDep, body: Acceptance) -> CalibrationRead:
    """Store the camera, or a new revision with source `calibration` that keeps the description; once, however often."""
    if record.result is None:
        raise Conflict(f"This calibration is {record.state} and has no result: only one that succeeded is accepted.")
    camera = RESULT.validate_python(record.result).to_camera()
    return CalibrationRead.model_validate(calibrations.accept(record.id, body.camera or record.camera, camera))


@router.delete(
    "/calibrations/{id}",
    operation_id="cancelCalibration",
    status_code=204,
    response_class=Response,
    summary="Cancel a calibration",
    responses=responses(NotFound, *WRITE_ERRORS),
)
def cancel_calibration(
    calibration_id: CalibrationId, calibrations: CalibrationsDep, spool: SpoolDep, runner: RunnerDep
) -> None:
    """Stop it and remove its photographs. It stays readable; one that has ended stays as it is."""
    if calibrations.cancel(calibration_id) == "queued":
        spool.remove(calibration_id)
    runner.wake()


async def _changes(
    app: FastAPI, calibrations: Calibrations, record: CalibrationRecord
) -> AsyncIterator[CalibrationRecord]:
    """The calibration now, and again after each change until it has ended or the service stops.

    Asked of the database, for the process that works on it may be another one.
    """
    yield record
    while not (record.has_ended or app.state.is_stopping):
        await asyncio.sleep(LOOK_S)
        with suppress(Busy, NotReady):
            if await run_in_threadpool(calibrations.version, record.id) != record.version:
                record = await run_in_threadpool(calibrations.get, record.id)
                yield record


async def _waited(
    app: FastAPI, calibrations: Calibrations, record: CalibrationRecord, wait_s: int
) -> CalibrationRecord:
    """The calibration when it has ended, or as it is after the wait."""
    with suppress(TimeoutError):
        async with asyncio.timeout(wait_s):
            async for now in _changes(app, calibrations, record):
                record = now
    return record
