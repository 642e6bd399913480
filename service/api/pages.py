"""``GET /``: the page."""

from pathlib import Path

from fastapi import APIRouter
from starlette.responses import FileResponse

PAGE = Path(__file__).parents[1] / "web" / "index.html"

router = APIRouter(include_in_schema=False)


@router.get("/")
async def read_page() -> FileResponse:
    """A short page with the way to everything else."""
    return FileResponse(PAGE, media_type="text/html")
