"""``camind cameras``: those in the database."""

from typing import TYPE_CHECKING, Annotated

import typer
from sqlalchemy import Engine

from service.commands.failures import WRONG_USE, failure, plain_failures
from service.commands.opened import ready_engine
from service.commands.options import Owner
from service.errors import Conflict, NotFound
from service.principal import LOCAL

if TYPE_CHECKING:
    from service.storage.cameras import CameraDraft, CameraRecord, Cameras

CameraName = Annotated[str, typer.Argument(help="Of the camera")]

app = typer.Typer(help="The cameras in the database.", no_args_is_help=True)


@app.command(name="seed")
def seed_cameras(owner: Owner = LOCAL) -> None:
    """Store the cameras of the paper's Table 1; names already there are left as they are."""
    with ready_engine() as engine:
        names = store_seeds(engine, owner)
    typer.echo("\n".join(names) if names else "Every seed is there already.")


def store_seeds(engine: Engine, owner: str) -> list[str]:
    """Store those of the paper's Table 1 that are not there; the names of the new ones."""
    from service.storage.cameras import Cameras
    from service.storage.seeds import seed

    return seed(Cameras(engine, owner))


@app.command(name="add")
def add_camera(
    file: Annotated[
        typer.FileBinaryRead,
        typer.Argument(help="JSON as POST /cameras takes it, or as the page exports cameras; - for standard input"),
    ],
    replace: Annotated[
        bool, typer.Option("--replace", help="A new revision, where a camera of that name is there and not the same")
    ] = False,
    owner: Owner = LOCAL,
) -> None:
    """Store a camera, known by its k_cam and gamma or by its lens specs, or several."""
    import json

    from pydantic import ValidationError

    from service.api.camera_schemas import CameraCreate
    from service.api.problems import invalid_model
    from service.storage.cameras import Cameras

    with plain_failures():
        try:
            told = json.load(file)
            bodies = told["cameras"] if isinstance(told, dict) and isinstance(told.get("cameras"), list) else [told]
            drafts = [body.to_draft(body.name) for body in map(CameraCreate.model_validate, bodies)]
        except ValidationError as exc:
            raise failure(str(invalid_model(exc, "body")), WRONG_USE) from exc
        except ValueError as exc:
            raise failure(f"This is not valid JSON: {exc}", WRONG_USE) from exc
        with ready_engine() as engine:
            for draft in drafts:
                typer.echo(_line_of(_stored(Cameras(engine, owner), draft, replace=replace)))


def _stored(cameras: "Cameras", draft: "CameraDraft", *, replace: bool) -> "CameraRecord":
    """The camera, new, or at a new revision, or as it is where that would be the same."""
    try:
        return cameras.add(draft)
    except Conflict as exc:
        if not replace:
            raise failure(f"A camera '{draft.name}' exists already: --replace gives it a new revision.") from exc
    record = cameras.get(draft.name)
    if record.draft != draft:
        return cameras.replace(draft)
    typer.echo("unchanged:", err=True)
    return record


@app.command(name="show")
def show_camera(name: CameraName, owner: Owner = LOCAL) -> None:
    """Print a camera as the JSON that add takes."""
    from service.api.camera_schemas import CameraCreate

    with ready_engine() as engine:
        record = stored_camera(engine, owner, name)
    typer.echo(CameraCreate.from_record(record).model_dump_json(indent=2, exclude_none=True))


@app.command(name="delete")
def delete_camera(name: CameraName, owner: Owner = LOCAL) -> None:
    """Free a camera's name; what was stored of it stays in the database."""
    from service.storage.cameras import Cameras

    with ready_engine() as engine:
        record = stored_camera(engine, owner, name)
        Cameras(engine, owner).delete(name)
    typer.echo(_line_of(record))


def stored_camera(engine: Engine, owner: str, name: str) -> "CameraRecord":
    """The camera; where there is none it is said who else has one of that name."""
    from service.storage.cameras import Cameras, camera_counts

    try:
        return Cameras(engine, owner).get(name)
    except NotFound as exc:
        told = "camind cameras list names those there are, camind cameras add stores one"
        others = _of_others(camera_counts(engine, name))
        raise failure(f"There is no camera '{name[:64]}'{others}: {told}.") from exc


def _of_others(counts: dict[str, int]) -> str:
    """Who else has cameras, to be said after a sentence that there is none."""
    owners = ", ".join(f"{count} of {owner}" for owner, count in counts.items())
    return f" of this owner, but {owners} (--owner)" if owners else ""


@app.command(name="list")
def list_cameras(owner: Owner = LOCAL) -> None:
    """Print name, revision, k_cam, focus distance and image size, a camera a line."""
    from service.storage.cameras import Cameras, camera_counts

    with ready_engine() as engine:
        cameras, after, has_more = Cameras(engine, owner), None, True
        while has_more:
            records, has_more = cameras.page(100, after)
            for record in records:
                typer.echo(_line_of(record))
            after = records[-1].name if records else None
        if after is None and (others := _of_others(camera_counts(engine))):
            typer.echo(f"There is no camera{others}.", err=True)


def _line_of(record: "CameraRecord") -> str:
    camera = record.camera
    size = f"{camera.image_width_px}x{camera.image_height_px}"
    return f"{record.name}\tr{record.revision}\t{camera.k_cam_px:.4g} px\t{camera.focus_distance_m:g} m\t{size}"
