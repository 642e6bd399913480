"""Errors on the wire: every one is problem+json (RFC 9457), and every route documents the ones it raises."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any

from pydantic import BaseModel, Field, ValidationError
from pydantic.json_schema import SkipJsonSchema
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.errors import BadRequest, Busy, CamindError, FieldProblem, InsufficientStorage, NotReady
from service.optics.camera import Lens

PROBLEM_TYPE = "application/problem+json"
# where a scope says which problem it was answered with
PROBLEM_KEY = "camind.problem"
TYPE_PREFIX = "urn:camind:problem:"
MAX_ERRORS = 50
# pydantic's kinds of faults that are told in plainer words than its own
A_NUMBER, A_WHOLE_NUMBER = "this must be a number", "this must be a whole number"
AN_OBJECT = "this must be a JSON object"
PLAIN_WORDS = {
    "missing": "this is required",
    "model_type": AN_OBJECT,
    "model_attributes_type": AN_OBJECT,
    "string_type": "this must be a string",
    "float_type": A_NUMBER,
    "float_parsing": A_NUMBER,
    "finite_number": "this must be a finite number",
    "int_type": A_WHOLE_NUMBER,
    "int_parsing": A_WHOLE_NUMBER,
    "int_from_float": A_WHOLE_NUMBER,
    "bool_type": "this must be true or false",
}
LENS_FIELDS = frozenset(field.name for field in fields(Lens))
# what reading the database may answer, and what writing to it may
STORE_ERRORS = (Busy, NotReady)
WRITE_ERRORS = (*STORE_ERRORS, InsufficientStorage)
# by status, a header's name, type and meaning
ERROR_HEADERS = {
    401: ("WWW-Authenticate", "string", "What is asked for"),
    403: ("WWW-Authenticate", "string", "The scope that the key lacks; `cross-origin` has none"),
    429: ("Retry-After", "integer", "Seconds to wait"),
    503: ("Retry-After", "integer", "Seconds to wait; `not-ready` has none"),
}


class ProblemField(BaseModel):
    """One fault at one place."""

    pointer: Annotated[
        str,
        Field(description="JSON pointer into the body (`#/lens/f_number`), or a parameter's or header's name"),
    ]
    detail: str


def _without_default(schema: dict[str, Any]) -> None:
    del schema["default"]  # what is left out is no null


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: Annotated[str, Field(description="Stable name of the kind of problem")]
    title: str
    status: int
    detail: Annotated[str, Field(description="What is wrong, and what to do")]
    errors: Annotated[
        list[ProblemField] | SkipJsonSchema[None],
        Field(description="The fields at fault; left out where there are none", json_schema_extra=_without_default),
    ] = None


def problem(error: CamindError) -> Problem:
    """The error as problem details."""
    return _told(error, error.detail, error.errors)


def _told(kind: CamindError | type[CamindError], detail: str, faults: Sequence[FieldProblem]) -> Problem:
    errors = [ProblemField(pointer=fault.pointer, detail=fault.detail) for fault in faults]
    return Problem(
        type=TYPE_PREFIX + kind.code, title=kind.title, status=kind.status, detail=detail, errors=errors or None
    )


class _ProblemResponse(Response):
    """A response that notes in the scope which problem it is."""

    media_type = PROBLEM_TYPE
    code: str

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        scope[PROBLEM_KEY] = self.code
        await super().__call__(scope, receive, send)


def problem_response(error: CamindError) -> Response:
    """The error as a response, with the headers that belong to it."""
    response = _ProblemResponse(
        problem(error).model_dump_json(exclude_none=True),
        status_code=error.status,
        headers={"Cache-Control": "no-store", **error.headers},
    )
    response.code = error.code
    return response


TAKEN = "A camera 'd200' exists already: replace it with PUT /cameras/d200."
EXAMPLES = {
    "invalid-request": "lens.focal_length_mm: Input should be greater than or equal to 0.1",
    "invalid-image": "The jpeg file is cut off: it ends before the picture does.",
    "image-size-mismatch": (
        "The photograph has 640x480 pixels upright, the camera 645x432: send the whole frame, not a crop; a region "
        "that the sensor reads out is a camera of its own, of that size, with k_cam_px as it is (by lens specs, "
        "sensor_width_px is the region's)."
    ),
    "idempotency-key-reused": (
        "This Idempotency-Key came with another request before: send a new key with a new request."
    ),
    "unauthorized": "This API key is unknown, revoked or expired: ask the operator for another.",
    "forbidden": "This API key lacks the scope depth: use one that has it.",
    "unknown-host": "The service is not known by this name: add it to CAMIND_HOSTS, or serve with API keys.",
    "cross-origin": (
        "This was sent by another site's page: only the service's own page, and those of CAMIND_ORIGINS, may."
    ),
    "quota-exceeded": "This API key has used its 600 requests of this minute: wait the seconds of Retry-After.",
    "not-found": "There is no camera 'd200': register it with POST /cameras.",
    "conflict": TAKEN,
    "precondition-failed": "Camera 'd200' is at revision 3: read it again, then repeat with If-Match: \"3\".",
    "too-large": "The request body may have at most 40000000 bytes.",
    "unsupported-kind": "Send JSON with the header Content-Type: application/json, not text/plain.",
    "not-acceptable": (
        "No format fits this Accept header: ask for one of image/png, application/x-npy, application/x-npz, "
        "image/tiff, application/x-ply, image/jpeg, application/json."
    ),
    "receive-timeout": "The request body came too slowly: less than 32 kB/s for 30 s.",
    "busy": "17 requests run or wait, with room for no more: try again later.",
    "not-ready": "The database cannot be used: the service's log says why.",
    "insufficient-storage": "The database's disk is full and nothing was changed: even to delete takes some room.",
    "internal-error": "Something went wrong here; the log has it under this X-Request-Id.",
}
EXAMPLE_FAULTS = {
    "invalid-request": FieldProblem("#/lens/focal_length_mm", "Input should be greater than or equal to 0.1"),
    "conflict": FieldProblem("#/name", TAKEN),
}


def responses(*errors: type[CamindError]) -> dict[int | str, dict[str, Any]]:
    """What a route passes as ``responses=``: one entry per status, one example per kind of error, and 500."""
    documented: dict[int | str, dict[str, Any]] = {}
    every: tuple[type[CamindError], ...] = (*errors, CamindError)
    for error in every:
        entry = documented.setdefault(error.status, _empty_entry(error))
        faults = [EXAMPLE_FAULTS[error.code]] if error.code in EXAMPLE_FAULTS else []
        example = _told(error, EXAMPLES[error.code], faults).model_dump(exclude_none=True)
        entry["content"][PROBLEM_TYPE]["examples"][error.code] = {"summary": error.title, "value": example}
    return documented


def _empty_entry(error: type[CamindError]) -> dict[str, Any]:
    schema = {"$ref": "#/components/schemas/Problem"}
    entry: dict[str, Any] = {
        "description": error.title,
        "content": {PROBLEM_TYPE: {"schema": schema, "examples": {}}},
    }
    if error.status in ERROR_HEADERS:
        name, kind, meaning = ERROR_HEADERS[error.status]
        entry["headers"] = {name: {"description": meaning, "schema": {"type": kind}}}
    return entry


def invalid_request(faults: Sequence[Mapping[str, Any]]) -> BadRequest:
    """Pydantic's faults as one error; what the client sent is never echoed, only where it went wrong."""
    # an unknown field often is the missing one, wrongly named: it explains most, so it comes first
    ordered = sorted(faults, key=lambda fault: bool(fault["type"] != "extra_forbidden"))
    # to word thousands of them would hold up everybody
    fields = tuple(FieldProblem(_pointer(fault), _detail(fault)) for fault in ordered[:MAX_ERRORS])
    first = fields[0]
    where = first.pointer.removeprefix("#").strip("/").replace("/", ".") or "body"
    return BadRequest(f"{where}: {first.detail}", errors=fields)


def invalid_model(exc: ValidationError, source: str) -> BadRequest:
    """The same of a model that no request brought: ``source`` is where its fields are from, ``body`` for JSON."""
    return invalid_request([{**fault, "loc": (source, *fault["loc"])} for fault in exc.errors()])


def _pointer(fault: Mapping[str, Any]) -> str:
    source, *path = fault["loc"] or ("body",)
    if fault["type"] == "json_invalid" or (source == "body" and not path):
        return "#"
    if source != "body":
        return ".".join(map(printable, path)) or str(source)
    return "#" + "".join(f"/{printable(part).replace('~', '~0').replace('/', '~1')}" for part in path)


def _detail(fault: Mapping[str, Any]) -> str:
    if fault["type"] == "json_invalid":
        return f"this is not valid JSON: {fault['ctx']['error']} at character {fault['loc'][-1]}"
    if fault["type"] == "extra_forbidden":
        return _unknown_field(*map(str, fault["loc"]))
    words = PLAIN_WORDS.get(fault["type"], str(fault["msg"]))
    return printable(words.removeprefix("Value error, "))


def _unknown_field(source: str, *path: str) -> str:
    name = path[-1]
    if (source, path) == ("body", (name,)) and name in LENS_FIELDS:
        return f'this belongs to the lens: send it there, as in {{"lens": {{"{name}": ...}}}}'
    if re.search("35_?mm|equivalent", name, re.IGNORECASE):
        return (
            "a 35-mm-equivalent focal length is not that of the lens, and k_cam grows with its square: "
            "send the real one as focal_length_mm (printed on the lens, and FocalLength in EXIF)"
        )
    kind = "parameter" if source == "query" else "field"
    return f"there is no such {kind}: remove it, or correct its name"


def printable(part: object) -> str:
    """Text that commands no terminal, and is short: control characters become question marks."""
    return re.sub(r"[\x00-\x1f\x7f]", "?", str(part))[:200]
