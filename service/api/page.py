"""``GET /`` and ``/web/...``: the page and its files, as they lie in ``service/web``."""

from pathlib import Path, PurePosixPath

from fastapi import APIRouter, Request
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

WEB = Path(__file__).parents[1] / "web"
PAGE = "index.html"
# the system's own table of media types is not to be relied on, and a module of another type does not run
KINDS = {
    ".css": "text/css; charset=utf-8",
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
POLICY = {
    "default-src": "'none'",
    "script-src": "'self'",
    "style-src": "'self'",
    "img-src": "'self' blob: data:",
    "connect-src": "'self'",
    "worker-src": "'self'",
    "font-src": "'self'",
    "manifest-src": "'self'",
    "base-uri": "'none'",
    "form-action": "'none'",
    "frame-ancestors": "'none'",
}
HEADERS = {
    # kept, but asked for each time whether it is still the one
    "Cache-Control": "no-cache",
    "Content-Security-Policy": "; ".join(f"{name} {sources}" for name, sources in POLICY.items()),
    "Referrer-Policy": "no-referrer",
}

router = APIRouter(include_in_schema=False)
_files = StaticFiles(directory=WEB)


@router.get("/")
async def read_page(request: Request) -> Response:
    """The page."""
    return await _answer(PAGE, request)


@router.get("/web/{path:path}")
async def read_page_file(path: str, request: Request) -> Response:
    """A file of the page; what the folder holds besides is not served."""
    kind = KINDS.get(PurePosixPath(path).suffix)
    if kind is None or path == PAGE:
        raise HTTPException(404)
    return await _answer(path, request)


async def _answer(path: str, request: Request) -> Response:
    response = await _files.get_response(path, request.scope)
    response.headers.update(HEADERS)
    if response.status_code != 304:
        response.headers["Content-Type"] = KINDS[PurePosixPath(path).suffix]
    return response
