"""``/health``: whether the process lives, and whether it can do its work."""

from typing import Annotated, Literal

from fastapi import APIRouter, Request
from pydantic import BaseModel, Field

from service.api.problems import responses
from service.errors import Busy, NotReady
from service.storage.engine import require_writable
from service.storage.schema import require_head

router = APIRouter(prefix="/health", tags=["service"])


class Live(BaseModel):
    """The process answers."""

    status: Literal["live"] = "live"


class Ready(BaseModel):
    """Every part is up."""

    status: Literal["ready"] = "ready"
    model: Annotated[str, Field(description="Name of the model served, warmed up")]
    database: Literal["writable"] = "writable"
    schema_: Annotated[Literal["head"], Field(alias="schema", description="All migrations ran")] = "head"


@router.get("/live", operation_id="readLiveness", summary="Is the process alive?", responses=responses())
async def read_liveness() -> Live:
    """Answers as long as the process does; it asks nothing of model or database."""
    return Live()


@router.get(
    "/ready",
    operation_id="readReadiness",
    summary="Can it do its work?",
    responses=responses(NotReady, Busy),
)
def read_readiness(request: Request) -> Ready:
    """200 when the model is warmed up, the database takes writes, and its schema is the newest; until a stop begins."""
    state = request.app.state
    if state.is_stopping:
        raise NotReady("The service is stopping.")
    if not getattr(state, "is_warm", False):
        raise NotReady("The model is not warmed up yet: ask again in a few seconds.")
    require_head(state.engine)
    require_writable(state.engine)
    return Ready(model=state.model.manifest.name)
