"""The one place where exceptions become answers: ours, the framework's, and validation's."""

from collections.abc import Iterator

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.routing import Match

from service.api.problems import invalid_request, problem_response
from service.errors import BadRequest, Busy, CamindError, MethodNotAllowed, NotFound

METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE")

log = structlog.stdlib.get_logger("camind.request")


def install(app: FastAPI) -> None:
    """Register the handlers."""
    app.add_exception_handler(CamindError, answer_error)
    app.add_exception_handler(RequestValidationError, answer_error)
    app.add_exception_handler(HTTPException, answer_error)


async def answer_error(request: Request, exc: Exception) -> Response:
    """Any exception the routes let out, as problem+json; OPTIONS, which no route has, gets its Allow."""
    error = _translated(request, exc)
    if isinstance(error, MethodNotAllowed) and request.method == "OPTIONS":
        return Response(status_code=204, headers=error.headers)
    log_fault(error)
    return problem_response(error)


def log_fault(error: CamindError) -> None:
    """Tell the log what is behind a fault of the service's own; a full queue, which has no cause, is none."""
    if error.status >= 500 and (error.__cause__ is not None or not isinstance(error, Busy)):
        log.error("unavailable", detail=error.detail, cause=repr(error.__cause__))


def _translated(request: Request, exc: Exception) -> CamindError:
    if isinstance(exc, CamindError):
        return exc
    if isinstance(exc, RequestValidationError):
        return invalid_request(exc.errors())
    if not isinstance(exc, HTTPException):
        raise exc
    # reading the body is done by the framework, which wraps what our limits raise
    if isinstance(exc.__cause__, CamindError):
        return exc.__cause__
    if exc.status_code == 404:
        return NotFound(f"There is nothing at {request.url.path[:200]}: see /docs for what there is.")
    if exc.status_code == 405:
        allow = tuple(_allowed(request))
        return MethodNotAllowed(f"This path accepts only {', '.join(allow)}.", allow=allow)
    return BadRequest("The body cannot be read: send all of it, in the format that its Content-Type names.")


def _allowed(request: Request) -> Iterator[str]:
    """The methods that the path's routes answer, over all of them."""
    for method in METHODS:
        scope = {**request.scope, "method": method}
        if any(route.matches(dict(scope))[0] is Match.FULL for route in request.app.router.routes):
            yield method
            if method == "GET":
                yield "HEAD"
    yield "OPTIONS"
