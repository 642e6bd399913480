"""Decoders that are not trusted with the service's own process: HEIC, AVIF and raw files.

Each file gets a process of its own, with bounds on memory and time, nothing of the service's environment and no way to
open anything. One that hangs, dies or answers nonsense is a damaged file; the service goes on.
"""

import importlib.util
import struct
import subprocess
import sys
import threading
from contextlib import suppress
from io import BufferedReader, BufferedWriter
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from service.errors import Busy, InvalidImage, TooLarge, UnsupportedKind
from service.inference.isolated_decoder import DECODED, HEAD, TOO_LARGE

PROGRAM = Path(__file__).with_name("isolated_decoder.py")
# the module that decodes a kind, and the extra that brings it; what decodes AVIF is always there
MODULES = {"heic": ("pi_heif", "heic"), "raw": ("rawpy", "raw")}
CPU_S = 30
WALL_S = 60.0
MEMORY_BYTES = 256 * 2**20
MEMORY_BYTES_PER_PIXEL = 16
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def decode_isolated(kind: str, data: bytes, max_pixels: int) -> NDArray[np.uint8]:
    """The pixels [h, w, 3] RGB, or [h, w, 4] with alpha, of a HEIC, upright, or of an AVIF or raw file, as stored.

    Raises ``UnsupportedKind`` without the extra, ``TooLarge``, ``InvalidImage`` and ``Busy``.
    """
    module, extra = MODULES.get(kind, ("PIL", ""))
    if importlib.util.find_spec(module) is None:
        raise UnsupportedKind(f"A {kind} file needs the service's extra '{extra}', which is not installed: send JPEG.")
    memory_bytes = MEMORY_BYTES + MEMORY_BYTES_PER_PIXEL * max_pixels
    command: list[str | Path] = [sys.executable, "-I", PROGRAM, kind, str(max_pixels), str(memory_bytes), str(CPU_S)]
    with _started(command) as process:
        clock = threading.Timer(WALL_S, process.kill)
        clock.start()
        try:
            _hand_over(data, cast(BufferedWriter, process.stdin))
            return _answer(cast(BufferedReader, process.stdout), kind, max_pixels)
        finally:
            clock.cancel()
            process.kill()


def _started(command: list[str | Path]) -> "subprocess.Popen[bytes]":
    try:
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=ENVIRONMENT, cwd="/"
        )
    except OSError as exc:
        raise Busy("There is no room for another process: try again later.") from exc


def _hand_over(data: bytes, stream: BufferedWriter) -> None:
    """Write all of the file: it is read before anything is answered."""
    try:
        stream.write(data)
    except BrokenPipeError:
        return  # there is no answer either
    finally:
        with suppress(BrokenPipeError):
            stream.close()


def _answer(stream: BufferedReader, kind: str, max_pixels: int) -> NDArray[np.uint8]:
    """The pixels, and never more bytes than allowed."""
    try:
        status, width_px, height_px, channels = HEAD.unpack(stream.read(HEAD.size))
    except struct.error as exc:
        raise InvalidImage(f"The {kind} file was given up: decoding it takes too much time or memory.") from exc
    if status == TOO_LARGE or width_px * height_px > max_pixels:
        raise TooLarge(f"The picture has {width_px}x{height_px} pixels, more than the {max_pixels} accepted.")
    if status != DECODED or channels not in (3, 4):
        raise InvalidImage(f"The {kind} file cannot be decoded: it is cut off or damaged.")
    pixels = np.empty((height_px, width_px, channels), np.uint8)
    if not pixels.size or stream.readinto(pixels.data.cast("B")) != pixels.size:
        raise InvalidImage(f"The {kind} file cannot be decoded: its decoder broke off.")
    return pixels
