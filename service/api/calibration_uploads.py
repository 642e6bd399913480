"""The form of a calibration: settings, and photographs that go to the disk piece by piece as they come."""

import re
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header

from service.api.calibration_schemas import SETTINGS_FIELD
from service.api.problems import invalid_request, printable
from service.api.uploads import MULTIPART
from service.errors import BadRequest, InvalidImage, TooLarge, UnsupportedKind
from service.inference.headers import sniff
from service.storage.calibrations import StoredPicture
from service.storage.disk import storing, write_through
from service.storage.spool import picture_file

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

FOCUSED, DEFOCUSED = "focused", "defocused"
ROLES = (FOCUSED, DEFOCUSED)
MAGIC_BYTES = 16
MOST_NAME = 100
# beside the photographs: the settings, and file inputs that nobody filled
SPARE_PARTS = 10


@dataclass(frozen=True, slots=True)
class FormLimits:
    """The most photographs, and the most bytes of each and of the settings."""

    max_pictures: int
    max_picture_bytes: int
    max_settings_bytes: int


@dataclass(frozen=True, slots=True)
class Form:
    """What came: the settings as text, and the photographs in the order of their files."""

    settings: bytes
    pictures: tuple[StoredPicture, ...]


async def receive_form(request: Request, folder: Path, limits: FormLimits) -> Form:
    """Receive a calibration's form; its photographs are on the disk, in ``folder``, when this returns.

    Raises ``UnsupportedKind`` (no form), ``TooLarge``, ``InvalidImage`` (no photograph among the defocused),
    ``BadRequest`` (a field that is missing, unknown or double, a damaged form), ``InsufficientStorage`` (a full disk)
    and ``NotReady`` (one that fails).
    """
    parts = _Parts(folder, limits)
    parser = MultipartParser(_boundary(request), parts.callbacks())
    try:
        async for chunk in request.stream():
            await run_in_threadpool(_write, parser, chunk)
        return parts.form()
    finally:
        parts.close()


def _boundary(request: Request) -> bytes:
    media_type, options = parse_options_header(request.headers.get("content-type"))
    if media_type != MULTIPART.encode():
        raise UnsupportedKind(f"Send {MULTIPART} with the fields {SETTINGS_FIELD}, {FOCUSED} and {DEFOCUSED}.")
    if not 0 < len(options.get(b"boundary", b"")) <= 200:
        raise BadRequest("The form cannot be read: its Content-Type names no boundary.")
    return options[b"boundary"]


def _write(parser: MultipartParser, chunk: bytes) -> None:
    try:
        with storing():
            parser.write(chunk)
    except FormParserError as exc:
        raise BadRequest(f"The form cannot be read ({exc}).") from exc


@dataclass(slots=True)
class _Part:
    """The part that is coming."""

    headers: dict[bytes, bytes] = field(default_factory=dict)
    header_name: bytes = b""
    header_value: bytes = b""
    role: str = ""
    file_name: str | None = None
    size_bytes: int = 0
    magic: bytes = b""
    file: BinaryIO | None = None


class _Parts:
    """A parser's callbacks: every part goes to its place, and no more of it than the limits allow."""

    def __init__(self, folder: Path, limits: FormLimits) -> None:
        self._folder = folder
        self._limits = limits
        self._part = _Part()
        self._begun = 0
        self._settings: bytearray | None = None
        self._pictures: list[StoredPicture] = []
        self._has_photograph = False
        self._is_whole = False

    def callbacks(self) -> "MultipartCallbacks":
        return {
            "on_part_begin": self._begin,
            "on_header_field": self._name_header,
            "on_header_value": self._fill_header,
            "on_header_end": self._end_header,
            "on_headers_finished": self._open,
            "on_part_data": self._take,
            "on_part_end": self._end,
            "on_end": self._finish,
        }

    def form(self) -> Form:
        """The form, once all of it came."""
        if not self._is_whole:
            raise BadRequest("The form is cut off: send it whole.")
        for name, is_there in (
            (SETTINGS_FIELD, self._settings is not None),
            (DEFOCUSED, any(picture.role == DEFOCUSED for picture in self._pictures)),
        ):
            if not is_there:
                raise invalid_request([{"type": "missing", "loc": ("body", name), "msg": "Field required"}])
        if not self._has_photograph:
            detail = "None of these files is a photograph: send JPEG, PNG, TIFF, WebP, HEIC or DNG."
            raise InvalidImage.at(detail, f"#/{DEFOCUSED}")
        return Form(bytes(self._settings or b""), tuple(self._pictures))

    def close(self) -> None:
        """Close what a form that broke off left open."""
        if self._part.file is not None:
            # a full disk does not take what is left in the buffer either
            with suppress(OSError):
                self._part.file.close()

    def _begin(self) -> None:
        self._begun += 1
        if self._begun > self._limits.max_pictures + SPARE_PARTS:
            raise self._too_many()
        self._part = _Part()

    def _name_header(self, data: bytes, start: int, end: int) -> None:
        self._part.header_name += data[start:end]

    def _fill_header(self, data: bytes, start: int, end: int) -> None:
        self._part.header_value += data[start:end]

    def _end_header(self) -> None:
        self._part.headers[self._part.header_name.lower()] = self._part.header_value
        self._part.header_name = self._part.header_value = b""

    def _open(self) -> None:
        part = self._part
        _, options = parse_options_header(part.headers.get(b"content-disposition"))
        part.role = options.get(b"name", b"").decode(errors="replace")
        part.file_name = options[b"filename"].decode(errors="replace") if b"filename" in options else None
        if part.role == SETTINGS_FIELD and self._settings is None:
            self._settings = bytearray()
        elif part.role in ROLES:
            part.file = (self._folder / picture_file(len(self._pictures))).open("wb")
        elif part.role == SETTINGS_FIELD:
            raise BadRequest.at("Send the settings once.", f"#/{SETTINGS_FIELD}")
        else:
            raise invalid_request([{"type": "extra_forbidden", "loc": ("body", part.role), "msg": ""}])

    def _take(self, data: bytes, start: int, end: int) -> None:
        part = self._part
        part.size_bytes += end - start
        if part.file is None:
            self._take_settings(data[start:end])
            return
        if part.size_bytes > self._limits.max_picture_bytes:
            detail = f"A photograph may have at most {self._limits.max_picture_bytes} bytes."
            raise TooLarge.at(detail, f"#/{part.role}")
        if len(part.magic) < MAGIC_BYTES:
            part.magic += data[start : min(end, start + MAGIC_BYTES)]
        part.file.write(data[start:end])

    def _take_settings(self, data: bytes) -> None:
        if self._settings is None or self._part.size_bytes > self._limits.max_settings_bytes:
            raise TooLarge(f"The settings may have at most {self._limits.max_settings_bytes} bytes.")
        self._settings += data

    def _end(self) -> None:
        part = self._part
        if part.file is None:
            return
        write_through(part.file)
        part.file.close()
        # what a browser sends for a file input that nobody filled
        if part.size_bytes or part.file_name:
            if len(self._pictures) >= self._limits.max_pictures:
                raise self._too_many()
            self._has_photograph |= part.role == DEFOCUSED and sniff(part.magic) is not None
            self._pictures.append(StoredPicture(self._unused_name(part), part.role))

    def _too_many(self) -> TooLarge:
        return TooLarge(f"A calibration may have at most {self._limits.max_pictures} photographs.")

    def _finish(self) -> None:
        self._is_whole = True

    def _unused_name(self, part: _Part) -> str:
        """The user's name for the file, printable and different from the others'."""
        last = re.split(r"[/\\]", part.file_name or "")[-1]
        name = printable(last)[:MOST_NAME] or f"{part.role}-{len(self._pictures) + 1}"
        used = {picture.name for picture in self._pictures}
        numbered = (f"{name} ({number})" for number in count(2))
        return name if name not in used else next(each for each in numbered if each not in used)
