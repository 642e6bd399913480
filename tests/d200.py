"""The camera of the README, from its lens specs, as a client sends it."""

from typing import Any

D200: dict[str, Any] = {
    "name": "d200",
    "image_width_px": 645,
    "image_height_px": 432,
    "focus_distance_m": 2.0,
    "gamma_px": 0.5,
    "lens": {"focal_length_mm": 35, "f_number": 2.8, "pixel_pitch_um": 6.05, "sensor_width_px": 3872},
}
