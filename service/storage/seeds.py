"""The cameras of the paper's Table 1, from their lens specs, focused at 2 m.

k_r is 4 here, a disc's own; the paper's column was computed with 1 / sqrt(2), so its numbers are 5.66 times
these. The two phones have their lenses' real focal lengths; the paper took 35-mm equivalents for them.
"""

from dataclasses import dataclass

from service.errors import Conflict
from service.optics.camera import Camera, Lens
from service.storage.cameras import CameraDraft, Cameras

FOCUS_DISTANCE_M = 2.0


@dataclass(frozen=True, slots=True)
class Body:
    """A camera body or a phone's module: its name, and its whole sensor."""

    label: str
    slug: str
    pixel_pitch_um: float
    width_px: int
    height_px: int


CANON_T7 = Body("Canon EOS Rebel T7", "canon-t7", 3.72, 6000, 4000)
NIKON_D7500 = Body("Nikon D7500", "nikon-d7500", 4.19, 5568, 3712)
SONY_A7_IV = Body("Sony Alpha 7 IV", "sony-a7iv", 5.11, 7008, 4672)
PIXEL_7_WIDE = Body("Google Pixel 7 Pro, wide", "pixel7pro-wide", 1.2, 8160, 6144)
PIXEL_7_TELE = Body("Google Pixel 7 Pro, telephoto", "pixel7pro-tele", 0.7, 8000, 6000)

# body, lens, focal length in mm, f-number: the rows in the paper's order
TABLE_1: tuple[tuple[Body, str, float, float], ...] = (
    (CANON_T7, "EF-S", 18, 4.0),
    (CANON_T7, "EF-S", 55, 5.6),
    (CANON_T7, "EF 50mm", 50, 1.2),
    (CANON_T7, "EF 70-300mm", 70, 5.6),
    (NIKON_D7500, "Nikon AF-S", 50, 1.8),
    (NIKON_D7500, "AF-S DX NIKKOR", 18, 3.5),
    (NIKON_D7500, "AF-S DX NIKKOR", 18, 5.6),
    (NIKON_D7500, "AF-S DX NIKKOR", 55, 3.5),
    (NIKON_D7500, "AF-S DX NIKKOR", 55, 5.6),
    (SONY_A7_IV, "FE PZ 16-35mm", 16, 4.0),
    (SONY_A7_IV, "FE PZ 16-35mm", 35, 4.0),
    (SONY_A7_IV, "FE PZ 16-35mm", 16, 22.0),
    (SONY_A7_IV, "FE 70-200 mm", 70, 2.8),
    (SONY_A7_IV, "FE 70-200 mm", 200, 2.8),
    (SONY_A7_IV, "FE 70-200 mm", 70, 22.0),
    (PIXEL_7_WIDE, "wide", 6.81, 1.85),
    (PIXEL_7_TELE, "telephoto", 19.0, 2.55),
)


def seed_drafts() -> list[CameraDraft]:
    """Table 1 as cameras, named ``body-focal-length-f-number`` (``nikon-d7500-50mm-f1.8``)."""
    return [_draft(*row) for row in TABLE_1]


def seed(cameras: Cameras) -> list[str]:
    """Store the seeds that are missing, and return their names; a name already there is left as it is."""
    added = []
    for draft in seed_drafts():
        try:
            added.append(cameras.add(draft).name)
        except Conflict:
            continue
    return added


def _draft(body: Body, lens_name: str, focal_length_mm: float, f_number: float) -> CameraDraft:
    lens = Lens(focal_length_mm, f_number, body.pixel_pitch_um, body.width_px)
    camera = Camera(
        image_width_px=body.width_px,
        image_height_px=body.height_px,
        focus_distance_m=FOCUS_DISTANCE_M,
        k_cam_px=lens.k_cam_px(FOCUS_DISTANCE_M, body.width_px),
        focal_length_m=lens.focal_length_m,
        f_number=f_number,
    )
    name = f"{body.slug}-{focal_length_mm:g}mm-f{f_number:g}"
    return CameraDraft(name, camera, "lens", lens, f"{body.label}, {lens_name}, focused at 2 m (Table 1)")
