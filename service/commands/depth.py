"""``camind depth``: photographs to depth without a service."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from service.commands.cameras import stored_camera
from service.commands.failures import WRONG_USE, end_in_order, failure, plain_failures
from service.commands.opened import ready_engine, settings_with
from service.commands.options import Owner
from service.memory import lasting
from service.principal import LOCAL

app = typer.Typer()


@app.command()
def depth(
    photographs: Annotated[list[Path], typer.Argument(help="Photographs, or folders of them", exists=True)],
    camera: Annotated[str, typer.Option(help="Name of the camera that took them")],
    out: Annotated[Path, typer.Option(help="Folder to write to", file_okay=False)] = Path("depth"),
    formats: Annotated[
        list[str] | None,
        typer.Option("--format", help="png, npy, npz, tiff, ply, preview or json; may be repeated. [default: png]"),
    ] = None,
    side: Literal["auto", "near", "far"] = "auto",
    focus_distance_m: Annotated[float | None, typer.Option(help="Theirs, if not the camera's")] = None,
    at: Annotated[list[str] | None, typer.Option(help="Pixel u,v to read; may be repeated")] = None,
    maps: Annotated[
        list[str] | None, typer.Option(help="Map that an npz holds; may be repeated. [default: all]")
    ] = None,
    known: Annotated[list[str] | None, typer.Option(help="Known depth u,v,depth_m; may be repeated")] = None,
    roi: Annotated[str | None, typer.Option(help="Part u0,v0,u1,v1 to answer alone")] = None,
    longest_px: Annotated[int | None, typer.Option(help="Longer side of the map at most. [default: full size]")] = None,
    only_missing: Annotated[bool, typer.Option("--only-missing", help="Leave out what is there already")] = False,
    model: Annotated[Path | None, typer.Option(help="Model folder. [default: the shipped model]")] = None,
    owner: Owner = LOCAL,
) -> None:
    """Photographs to depth, without a service: what POST /depth answers, into files.

    Exit codes: 0; 1 where one of them has no depth, 2 for wrong options.
    """
    end_in_order()
    settings, formats = settings_with(model_dir=model), formats or ["png"]
    with lasting():
        from service.commands.depth_folder import Errand, depth_folder, query_of
        from service.inference.images import ImageLimits

    lists = {"at": at or (), "maps": maps or (), "known": known or ()}
    asked = {"side": side, "focus_distance_m": focus_distance_m, "roi": roi, "longest_px": longest_px, **lists}
    try:
        query = query_of(camera, asked, formats)
        with plain_failures():
            with ready_engine() as engine:
                record = stored_camera(engine, owner, camera)
            errand = Errand(record, query, formats, ImageLimits.of(settings), out)
            failed = depth_folder(photographs, errand, settings, is_missing_only=only_missing)
    except ValueError as exc:
        raise failure(str(exc), WRONG_USE) from exc
    if failed:
        raise typer.Exit(1)
