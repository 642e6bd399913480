"""Who may do what: API keys in front of every request but those for health and the page, their scopes, and their quota.

Where no key is asked for, whoever is at this machine may do everything. Pages of other sites in their browser may not;
nor may a page whose own host name was bound to this machine (DNS rebinding), which the browser takes for the same site.

A scope is asked for by path, before a route or a body is looked at; a path that is not named here takes any key.
"""

import math
import re
import time
from collections.abc import Collection
from ipaddress import ip_address
from urllib.parse import urlsplit

from fastapi.concurrency import run_in_threadpool
from limits import RateLimitItemPerMinute
from limits.storage import MemoryStorage
from limits.strategies import MovingWindowRateLimiter
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import CrossOrigin, Forbidden, QuotaExceeded, Unauthorized, UnknownHost
from service.principal import ANYBODY, Principal
from service.principal import Scope as KeyScope
from service.storage.keys import ApiKey, Keys

# the page holds nobody's data, and is what asks for the key
PAGE = "/"
HEALTH = "/health"
PUBLIC = (HEALTH, "/web")
# what ends names that no stranger can have: RFC 6761, RFC 6762, RFC 8375, and ICANN's for private use
OWN_ENDS = (".localhost", ".local", ".internal", ".home.arpa", ".test")
READING = frozenset({"GET", "HEAD", "OPTIONS"})
# below each path: the scope to read, and the scope to do anything else; the longest path that fits counts
SCOPES_BY_PATH: dict[str, tuple[KeyScope | None, KeyScope | None]] = {
    "/depth": ("depth", "depth"),
    "/cameras": ("cameras:read", "cameras:write"),
    "/calibrate": ("calibrate", "calibrate"),
    "/calibrate/target.svg": (None, None),
    "/calibrate/target.pdf": (None, None),
    "/calibrations": ("calibrate", "calibrate"),
    "/metrics": ("admin", "admin"),
}
# a name or an address, and a port: what looks like more is no such name
HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[^][:/?#@\s]*)(:\d*)?", re.ASCII)
# a clock set back by this much makes what was counted count for as long again: it is forgotten
CLOCK_STEP_S = 1.0
CORS_HEADERS = {
    "Access-Control-Allow-Methods": "GET, HEAD, POST, PUT, DELETE",
    "Access-Control-Allow-Headers": (
        "Authorization, Content-Type, Idempotency-Key, If-Match, If-None-Match, Prefer, X-Request-Id"
    ),
    "Access-Control-Expose-Headers": (
        "ETag, Location, Preference-Applied, Retry-After, Server-Timing, WWW-Authenticate, X-Request-Id, "
        "Camind-Camera, Camind-Camera-Revision, Camind-Depth-Scale-M, Camind-Focus-Distance-M, Camind-Model, "
        "Camind-Warnings"
    ),
    "Access-Control-Max-Age": "600",
}
# what only reads, though it is sent
SCOPES_OF_READING: dict[tuple[str, str], KeyScope] = {("POST", "/cameras/preview"): "cameras:read"}


class AllowOrigins:
    """Lets web pages of these origins read the answers (CORS), errors and what a browser asks beforehand included."""

    def __init__(self, app: ASGIApp, *, origins: Collection[str]) -> None:
        self._app = app
        self._origins = frozenset(origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        origin = Headers(scope=scope).get("origin") if scope["type"] == "http" else None
        if origin not in self._origins:
            await self._app(scope, receive, send)
            return

        async def allowed(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.update({"Access-Control-Allow-Origin": str(origin), **CORS_HEADERS})
                headers.add_vary_header("Origin")
            await send(message)

        await self._app(scope, receive, allowed)


class Authenticate:
    """Puts a ``Principal`` into the request's state: the key's owner, or ``ANYBODY`` where no key is asked for.

    Raises ``Unauthorized``, ``Forbidden`` and ``QuotaExceeded``; without keys ``CrossOrigin``, and ``UnknownHost`` for
    another name than ``hosts`` and those that no stranger can have. Pages of ``origins`` may do what the own one may.
    """

    def __init__(
        self,
        app: ASGIApp,
        *,
        is_on: bool,
        requests_per_minute: int,
        hosts: Collection[str],
        origins: Collection[str],
    ) -> None:
        self._app = app
        self._is_on = is_on
        self._hosts = frozenset(hosts)
        self._origins = frozenset(origins)
        self._quota = RateLimitItemPerMinute(requests_per_minute) if requests_per_minute else None
        self._limiter = MovingWindowRateLimiter(MemoryStorage())
        self._clock_ahead_s = -math.inf

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http":
            if not self._is_on:
                self._refuse_strangers(scope)
            state = scope.setdefault("state", {})
            state["principal"] = await self._principal(scope) if self._is_on else ANYBODY
        await self._app(scope, receive, send)

    def _refuse_strangers(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        if not _is_below(scope["path"], HEALTH) and not is_own_name(headers.get("host", ""), self._hosts):
            raise UnknownHost("The service is not known by this name: add it to CAMIND_HOSTS, or serve with API keys.")
        is_allowed = headers.get("origin") in self._origins
        if scope["method"] not in READING and not is_allowed and is_from_another_site(headers):
            raise CrossOrigin(
                "This was sent by another site's page: only the service's own page, and those of CAMIND_ORIGINS, may."
            )

    async def _principal(self, scope: Scope) -> Principal:
        headers = Headers(scope=scope)
        if is_public(scope["path"]) or _is_preflight(scope["method"], headers):
            return ANYBODY
        keys: Keys = scope["app"].state.keys
        scheme, _, text = headers.get("authorization", "").partition(" ")
        if scheme.lower() != "bearer":
            raise Unauthorized("Send an API key: Authorization: Bearer camind_...")
        key = await run_in_threadpool(keys.find, text.strip())
        if key is None:
            raise Unauthorized("This API key is unknown, revoked or expired: ask the operator for another.")
        self._count(key)
        needed = needed_scope(scope["method"], scope["path"])
        if needed is not None and needed not in key.scopes:
            raise Forbidden(f"This API key lacks the scope {needed}: use one that has it.", scope=needed)
        return Principal(key.owner, key.id)

    def _count(self, key: ApiKey) -> None:
        if self._quota is None:
            return
        clock_ahead_s = time.time() - time.monotonic()
        if clock_ahead_s < self._clock_ahead_s - CLOCK_STEP_S:
            self._limiter.storage.reset()
        self._clock_ahead_s = clock_ahead_s
        if self._limiter.hit(self._quota, key.id):
            return
        wait_s = self._limiter.get_window_stats(self._quota, key.id).reset_time - time.time()
        raise QuotaExceeded(
            f"This API key has used its {self._quota.amount} requests of this minute: wait the seconds of Retry-After.",
            retry_after_s=max(1, math.ceil(wait_s)),
        )


def is_from_another_site(headers: Headers) -> bool:
    """Whether a browser says that a page of another origin asks (W3C Fetch Metadata; ``Origin`` of older browsers)."""
    site, origin = headers.get("sec-fetch-site"), headers.get("origin")
    if site is not None:
        return site in ("cross-site", "same-site")
    try:
        return origin is not None and urlsplit(origin).netloc != headers.get("host")
    except ValueError:
        return True  # no page has an origin that is no address


def is_own_name(host: str, hosts: Collection[str]) -> bool:
    """Whether a ``Host`` header has one of these names, or one that no stranger can bind to this machine.

    That is an address, a name of one label, or one below a domain that the DNS at large does not have.
    """
    found = HOST.fullmatch(host)
    if found is None:
        return False
    name = found["name"].strip("[]").lower().removesuffix(".")
    if "." not in name or name.endswith(OWN_ENDS) or name in hosts:
        return True
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


def is_public(path: str) -> bool:
    """Whether the path answers without a key."""
    return path == PAGE or any(_is_below(path, prefix) for prefix in PUBLIC)


def _is_preflight(method: str, headers: Headers) -> bool:
    """Whether a browser asks what a page may ask: no key comes with that, and methods are all it is told."""
    return method == "OPTIONS" and "access-control-request-method" in headers


def needed_scope(method: str, path: str) -> KeyScope | None:
    """The scope a key must have for this; None where any key will do."""
    if (method, path) in SCOPES_OF_READING:
        return SCOPES_OF_READING[method, path]
    fitting = [prefix for prefix in SCOPES_BY_PATH if _is_below(path, prefix)]
    if not fitting:
        return None
    to_read, to_change = SCOPES_BY_PATH[max(fitting, key=len)]
    return to_read if method in READING else to_change


def _is_below(path: str, prefix: str) -> bool:
    return path == prefix or path.startswith(f"{prefix}/")
