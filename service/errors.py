"""Every error the service answers with, in one tree.

CamindError
├── BadRequest (422)           what was sent cannot be used
│   ├── InvalidImage           the bytes are no whole image
│   ├── ImageSizeMismatch      not the camera's frame
│   └── KeyReused              an Idempotency-Key that came with another request
├── Unauthorized (401)         no API key, or none that is good
├── Forbidden (403)            the API key lacks a scope
├── CrossOrigin (403)          another site's page asks for a change
├── NotFound (404)
├── MethodNotAllowed (405)     the path exists, the method does not
├── ReceiveTimeout (408)       the request came too slowly
├── Conflict (409)
├── PreconditionFailed (412)   If-Match names another revision
├── TooLarge (413)             too many bytes or pixels
├── UnsupportedKind (415)      a media type or file kind that is not listed
├── UnknownHost (421)          asked for by a name that may be a stranger's
├── NotAcceptable (406)        no representation fits Accept
├── QuotaExceeded (429)        the API key asked too often
├── Busy (503)                 the queue is full, or the deadline passed
├── NotReady (503)             a part of the service is not up
└── InsufficientStorage (507)  the disk is full

Domain code raises these and knows no HTTP beyond the class; one handler turns them into problem+json. What is no HTTP
request at all has two errors of its own (400 and 431), in ``service.server``.
"""

from dataclasses import dataclass
from typing import ClassVar, Self


@dataclass(frozen=True, slots=True)
class FieldProblem:
    """One fault at one place: a JSON pointer (``#/lens/f_number``) or a header's or parameter's name."""

    pointer: str
    detail: str


class CamindError(Exception):
    """Base: a status, a stable code (the end of ``type``), a title, and what is wrong with what to do."""

    status: ClassVar[int] = 500
    code: ClassVar[str] = "internal-error"
    title: ClassVar[str] = "Internal error"

    def __init__(self, detail: str, *, errors: tuple[FieldProblem, ...] = ()) -> None:
        super().__init__(detail)
        self.detail = detail
        self.errors = errors

    @classmethod
    def at(cls, detail: str, *pointers: str) -> Self:
        """The error as a fault at each of these places."""
        return cls(detail, errors=tuple(FieldProblem(pointer, detail) for pointer in pointers))

    @property
    def headers(self) -> dict[str, str]:
        """Headers that belong to this error."""
        return {}


def known_codes(base: type[CamindError] = CamindError) -> frozenset[str]:
    """The codes of all errors there are, of those that other modules define too."""
    return frozenset({base.code}).union(*(known_codes(error) for error in base.__subclasses__()))


class BadRequest(CamindError):
    status = 422
    code = "invalid-request"
    title = "Invalid request"


class InvalidImage(BadRequest):
    code = "invalid-image"
    title = "Invalid image"

    @classmethod
    def cut_off(cls, kind: str) -> Self:
        """The error for a file that ends early."""
        return cls(f"The {kind} file is cut off: it ends before the picture does.")


class ImageSizeMismatch(BadRequest):
    code = "image-size-mismatch"
    title = "Image does not fit the camera"


class KeyReused(BadRequest):
    code = "idempotency-key-reused"
    title = "Idempotency-Key was used before"


class Unauthorized(CamindError):
    status = 401
    code = "unauthorized"
    title = "API key needed"

    @property
    def headers(self) -> dict[str, str]:
        return {"WWW-Authenticate": "Bearer"}


class Forbidden(CamindError):
    status = 403
    code = "forbidden"
    title = "API key lacks a scope"

    def __init__(self, detail: str, *, scope: str) -> None:
        super().__init__(detail)
        self.scope = scope

    @property
    def headers(self) -> dict[str, str]:
        return {"WWW-Authenticate": f'Bearer error="insufficient_scope", scope="{self.scope}"'}


class CrossOrigin(CamindError):
    status = 403
    code = "cross-origin"
    title = "Request from another site's page"


class UnknownHost(CamindError):
    status = 421
    code = "unknown-host"
    title = "Unknown host name"


class NotFound(CamindError):
    status = 404
    code = "not-found"
    title = "Not found"


class MethodNotAllowed(CamindError):
    status = 405
    code = "method-not-allowed"
    title = "Method not allowed"

    def __init__(self, detail: str, *, allow: tuple[str, ...]) -> None:
        super().__init__(detail)
        self.allow = allow

    @property
    def headers(self) -> dict[str, str]:
        return {"Allow": ", ".join(self.allow)}


class ReceiveTimeout(CamindError):
    status = 408
    code = "receive-timeout"
    title = "Request came too slowly"


class Conflict(CamindError):
    status = 409
    code = "conflict"
    title = "Conflict"


class PreconditionFailed(CamindError):
    status = 412
    code = "precondition-failed"
    title = "Precondition failed"


class TooLarge(CamindError):
    status = 413
    code = "too-large"
    title = "Too large"


class UnsupportedKind(CamindError):
    status = 415
    code = "unsupported-kind"
    title = "Unsupported kind"


class NotAcceptable(CamindError):
    status = 406
    code = "not-acceptable"
    title = "Not acceptable"


class _Wait(CamindError):
    """One that says when to try again."""

    def __init__(self, detail: str, *, retry_after_s: int = 1) -> None:
        super().__init__(detail)
        self.retry_after_s = retry_after_s

    @property
    def headers(self) -> dict[str, str]:
        return {"Retry-After": str(self.retry_after_s)}


class QuotaExceeded(_Wait):
    status = 429
    code = "quota-exceeded"
    title = "Quota exceeded"


class Busy(_Wait):
    status = 503
    code = "busy"
    title = "Busy"


class NotReady(CamindError):
    status = 503
    code = "not-ready"
    title = "Not ready"


class InsufficientStorage(CamindError):
    status = 507
    code = "insufficient-storage"
    title = "Insufficient storage"
