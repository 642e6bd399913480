"""Furnished rooms, ray-traced sharp and with depth: frames for training, from freely licensed furniture.

The models are those of Sweet Home 3D's furniture libraries (``*.sh3f``, Debian's ``sweethome3d-furniture``): true
sizes, CC0 and CC-BY. ``homes_worker.py`` builds and renders the rooms in Blender's own environment.
"""

import json
import re
import zipfile
from collections import defaultdict
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from model_export.datasets.blender_environment import run_workers, shares
from model_export.datasets.photos import CAMERAS, write_depth, write_image
from model_export.textures import picture_files
from service.optics.light import encode_srgb

WORKER = Path(__file__).with_name("homes_worker.py")
CATALOGUE = "PluginFurnitureCatalog.properties"
ENTRY = re.compile(r"(\w+)#(\d+)=(.*)")
NOT_FURNITURE = {"Doors and windows", "Staircases", "Vehicles"}
LARGEST_M, LARGEST_FILE = 3.0, 1_500_000
CENTIMETRE_M = 0.01
VIEWS = 8
SIZE_PX = (400, 300)
SAMPLES = 8
WHITE_SHARE, DARKEST = 0.98, 1e-2
LICENCES = """- rooms furnished from Sweet Home 3D's libraries: BlendSwap CC-0 (CC0), BlendSwap CC-BY (its contributors,
  CC BY 3.0), KatorLegaz (Andrew Kator and Jennifer Legaz, CC BY 3.0), Reallusion (CC BY 3.0), Scopia (CC BY 3.0);
  rendered with Blender, some pieces painted anew.
"""
ENCODING = (cv2.IMWRITE_JPEG_QUALITY, 97, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


@dataclass(frozen=True, slots=True)
class Furniture:
    """A piece of furniture: an OBJ file, its width, depth and height, and at what height things stand on it."""

    path: str
    size_m: tuple[float, float, float]
    top_m: float | None


def unpack(libraries: Path, out: Path) -> list[Furniture]:
    """The models of all ``*.sh3f`` files of a folder, unpacked; what stands on a floor and upright.

    Raises ``FileNotFoundError`` if there is no library, ``ValueError`` for one that is damaged.
    """
    found = []
    for library in sorted(libraries.glob("*.sh3f")):
        folder = out / library.stem
        if not folder.is_dir():
            part = folder.with_suffix(".part")
            try:
                with zipfile.ZipFile(library) as packed:
                    packed.extractall(part)
            except zipfile.BadZipFile as exc:
                raise ValueError(f"{library} is damaged: {exc}") from exc
            part.rename(folder)
        found += _models(folder)
    if not found:
        raise FileNotFoundError(f"no furniture (*.sh3f) in {libraries}: Debian's package sweethome3d-furniture has it")
    return found


def _models(folder: Path) -> list[Furniture]:
    entries: dict[int, dict[str, str]] = defaultdict(dict)
    for line in (folder / CATALOGUE).read_text(encoding="latin-1").splitlines():
        if entry := ENTRY.match(line):
            entries[int(entry[2])][entry[1]] = entry[3].strip()
    found = []
    for told in entries.values():
        path = folder / told.get("model", "").lstrip("/")
        if not path.is_file() or path.stat().st_size > LARGEST_FILE or told.get("category") in NOT_FURNITURE:
            continue
        if told.get("modelRotation") or told.get("doorOrWindow") == "true" or float(told.get("elevation", 0)) > 0:
            continue
        width, depth, height = (float(told[name]) * CENTIMETRE_M for name in ("width", "depth", "height"))
        if max(width, depth, height) <= LARGEST_M:
            top_m = float(told.get("dropOnTopElevation", 0)) * CENTIMETRE_M
            found.append(Furniture(str(path), (width, depth, height), top_m if top_m > 0 else None))
    return found


def due(out: Path, count: int) -> list[dict[str, object]]:
    """What the worker is told of each of the first ``count`` rooms that is not in the folder in full."""
    width, height = SIZE_PX
    rooms = (
        {
            "name": f"home_{seed:05d}",
            "seed": seed,
            "views": VIEWS,
            "width_px": width,
            "height_px": height,
            "samples": SAMPLES,
        }
        for seed in range(count)
    )
    done = _known(out)
    return [room for room in rooms if f"{room['name']}_{VIEWS - 1}" not in done]


def _known(out: Path) -> dict[str, dict[str, float] | None]:
    """The camera of each view in the folder; None for one that showed nothing."""
    cameras = out / CAMERAS
    known: dict[str, dict[str, float] | None] = json.loads(cameras.read_text()) if cameras.is_file() else {}
    return known


def render(
    python: Path,
    models: list[Furniture],
    textures: Path,
    rooms: list[dict[str, object]],
    out: Path,
    on_progress: Callable[[str], None] = lambda _: None,
) -> None:
    """Render furnished rooms as frames: ``color/``, ``depth/`` and ``cameras.json``, and ``LICENCES.md``.

    Raises ``ChildProcessError`` with the worker's last words if it fails.
    """
    for part in ("color", "depth"):
        (out / part).mkdir(parents=True, exist_ok=True)
    (out / "LICENCES.md").write_text(LICENCES)
    known, raw = _known(out), out / "raw"

    def develop(name: str) -> None:
        rendered = raw / f"{name}.npz"
        known[name] = _developed(rendered, out) if rendered.is_file() else None
        scratch = out / f"{CAMERAS}.part"
        scratch.write_text(json.dumps(known, indent=1) + "\n")
        scratch.replace(out / CAMERAS)
        rendered.unlink(missing_ok=True)
        on_progress(name)

    pictures = [str(path) for path in picture_files(textures)]
    common = {"models": [asdict(model) for model in models], "pictures": pictures}
    run_workers(python, WORKER, [common | {"rooms": share} for share in shares(rooms)], raw, develop)


def _developed(rendered: Path, out: Path) -> dict[str, float] | None:
    """Write a view's picture and depth; its camera, or None for a view in the dark."""
    found = np.load(rendered)
    light = found["light"]
    white = float(np.quantile(light, WHITE_SHARE))
    if not white > DARKEST:
        return None
    picture = np.rint(encode_srgb(np.clip(light / white, 0, 1)) * 255).astype(np.uint8)
    write_image(out / "color" / f"{rendered.stem}.jpg", picture, ENCODING)
    write_depth(out / "depth" / f"{rendered.stem}.png", found["depth_m"])
    return {"fx_px": float(found["focal_length_px"])}
