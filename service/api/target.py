"""``GET /calibrate/target.svg|pdf``: the sheet to print."""

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from service.api.calibration_schemas import Circles, Millimetres
from service.api.problems import responses
from service.calibration.target import CircleGrid, Kind, Paper, Sheet, as_pdf, as_svg, lay_out
from service.errors import BadRequest

router = APIRouter(prefix="/calibrate", tags=["calibration"])


def grid_of_query(
    kind: Annotated[Kind, Query(description="How the circles stand")] = "asymmetric_circles",
    rows: Circles = 11,
    columns: Circles = 4,
    spacing_mm: Millimetres = 20.0,
    diameter_mm: Millimetres = 12.0,
) -> CircleGrid:
    """The grid that the query names. Raises ``BadRequest`` for circles that touch."""
    try:
        return CircleGrid(kind, rows, columns, spacing_mm, diameter_mm)
    except ValueError as exc:
        raise BadRequest.at(str(exc), "spacing_mm") from exc


GridDep = Annotated[CircleGrid, Depends(grid_of_query)]


def _sheet(grid: GridDep, paper: Annotated[Paper, Query(description="The sheet")] = "a4") -> Sheet:
    try:
        return lay_out(grid, paper)
    except ValueError as exc:
        raise BadRequest.at(str(exc), "spacing_mm", "paper") from exc  # another paper, or printer, may do


SheetDep = Annotated[Sheet, Depends(_sheet)]


@router.get(
    "/target.svg",
    operation_id="readTargetSvg",
    summary="The sheet to print, as SVG",
    response_class=Response,
    responses={200: {"content": {"image/svg+xml": {}}}, **responses(BadRequest)},
)
def read_target_svg(sheet: SheetDep) -> Response:
    """A grid of circles in true millimetres, with a ruler to check the print."""
    return Response(as_svg(sheet), media_type="image/svg+xml")


@router.get(
    "/target.pdf",
    operation_id="readTargetPdf",
    summary="The sheet to print, as PDF",
    response_class=Response,
    responses={200: {"content": {"application/pdf": {}}}, **responses(BadRequest)},
)
def read_target_pdf(sheet: SheetDep) -> Response:
    """A grid of circles in true millimetres, with a ruler to check the print."""
    return Response(as_pdf(sheet), media_type="application/pdf")
