"""The program that decodes HEIC, AVIF and raw files, in a process of its own: it imports nothing of the service.

``python -I isolated_decoder.py KIND MAX_PIXELS MEMORY_BYTES CPU_S`` takes the file on its standard input. Out go a
status, width, height and channels, and after ``DECODED`` the pixels, 8-bit RGB in sRGB, with alpha where there is any,
a HEIC's upright, others as stored.
"""

import importlib
import os
import resource
import struct
import sys
from collections.abc import Callable
from io import BytesIO

HEAD = struct.Struct(">cIIB")
DECODED, TOO_LARGE, DAMAGED = b"d", b"l", b"x"

Decoded = tuple[int, int, int, bytes]
Opened = tuple[int, int, Callable[[], Decoded]]


def confine(memory_bytes: int, cpu_s: int) -> None:
    """Bound memory and time; write no file and no core."""
    bounds = {
        resource.RLIMIT_AS: memory_bytes,
        resource.RLIMIT_CPU: cpu_s,
        resource.RLIMIT_FSIZE: 0,
        resource.RLIMIT_CORE: 0,
    }
    if sys.platform == "darwin":
        del bounds[resource.RLIMIT_AS]  # macOS refuses any such bound
    for limit, most in bounds.items():
        resource.setrlimit(limit, (most, most))


def shut_off() -> None:
    """Open nothing any more, no file and no socket: a descriptor is refused to whoever asks from here on."""
    resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))


def with_alpha(mode: str) -> str:
    """What a picture of this mode is converted to."""
    return "RGBA" if "A" in mode.upper() else "RGB"


def heic(data: bytes) -> Opened:
    """The primary picture of a HEIC: its stated size, and how to decode it."""
    import pi_heif
    from pi_heif import options

    options.DECODE_THREADS = 1
    options.THUMBNAILS = options.DEPTH_IMAGES = options.AUX_IMAGES = False
    shut_off()
    picture = pi_heif.open_heif(data, convert_hdr_to_8bit=True)

    def decode() -> Decoded:
        mode = with_alpha(picture.mode)
        pixels = picture.data if picture.mode == "RGB" else picture.to_pillow().convert(mode).tobytes()
        return *picture.size, len(mode), pixels

    return *picture.size, decode


def avif(data: bytes) -> Opened:
    """The first picture of an AVIF: its stated size, and how to decode it, as stored."""
    from PIL import AvifImagePlugin

    importlib.import_module("PIL.TiffImagePlugin")  # reads EXIF, and could not be opened later
    AvifImagePlugin.DEFAULT_MAX_THREADS = 1
    shut_off()
    picture = AvifImagePlugin.AvifImageFile(BytesIO(data))

    def decode() -> Decoded:
        mode = with_alpha(picture.mode)
        return *picture.size, len(mode), picture.convert(mode).tobytes()

    return *picture.size, decode


def raw(data: bytes) -> Opened:
    """A raw file: its stated size, and how to develop it, in the camera's white balance and no brighter."""
    import rawpy

    shut_off()
    picture = rawpy.RawPy()
    picture.open_buffer(BytesIO(data))

    def decode() -> Decoded:
        picture.unpack()
        developed = picture.postprocess(
            use_camera_wb=True, no_auto_bright=True, adjust_maximum_thr=0.0, gamma=(2.4, 12.92), user_flip=0
        )
        return developed.shape[1], developed.shape[0], 3, developed.tobytes()

    return picture.sizes.iwidth, picture.sizes.iheight, decode


DECODERS: dict[str, Callable[[bytes], Opened]] = {"heic": heic, "avif": avif, "raw": raw}


def main(kind: str, max_pixels: int, memory_bytes: int, cpu_s: int) -> None:
    """Answer for the file on standard input; whatever a library prints goes where errors go."""
    confine(memory_bytes, cpu_s)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)
        try:
            width_px, height_px, decode = DECODERS[kind](sys.stdin.buffer.read())
            if width_px * height_px > max_pixels:
                out.write(HEAD.pack(TOO_LARGE, width_px, height_px, 0))
                return
            width_px, height_px, channels, pixels = decode()
        except Exception:
            out.write(HEAD.pack(DAMAGED, 0, 0, 0))
            return
        out.write(HEAD.pack(DECODED, width_px, height_px, channels))
        out.write(pixels)


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
