"""``GET /model``: which model answers, what it was trained on, and its card."""

from typing import Annotated

from fastapi import APIRouter
from pydantic import BaseModel, Field

from service.api.dependencies import ModelDep
from service.api.problems import responses
from service.inference.artifact import Manifest

router = APIRouter(tags=["service"])


class ModelRead(BaseModel):
    """The model that is served."""

    manifest: Manifest
    card: Annotated[str, Field(description="The model card, Markdown")]


@router.get("/model", operation_id="readModel", summary="The model that answers", responses=responses())
def read_model(model: ModelDep) -> ModelRead:
    """Manifest (ranges trained on, scores, checksums, training) and model card."""
    return ModelRead(manifest=model.manifest, card=model.card())
