"""The page's files: what is served and how, that all of them are used, and that they are small."""

import re
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from service.api.page import KINDS, PAGE, WEB
from tests.web import pictures

MOST_BYTES = 250_000
ROOT = WEB.parents[1]
PROBLEM = "application/problem+json"
FILES = sorted(path for path in WEB.rglob("*") if path.is_file())
# types are for whoever writes the page
SERVED = [path for path in FILES if path.suffix in KINDS]
CHECKED_ONLY = {".ts"}


def address(path: Path) -> str:
    return "/" if path.name == PAGE else f"/web/{path.relative_to(WEB).as_posix()}"


def references(path: Path) -> set[Path]:
    """The page's own files that a file names: from the page's root as ``web/...``, or from where it lies itself."""
    text = path.read_text(encoding="utf-8")
    kinds = "|".join(kind.removeprefix(".") for kind in KINDS)
    from_root = re.findall(rf"""["'(]web/([\w./-]+\.(?:{kinds}))["')]""", text)
    beside = re.findall(rf"""["'(](\.{{1,2}}/[\w./-]+\.(?:{kinds}))["')]""", text)
    beside += re.findall(r"""new URL\("([\w./-]+)", import\.meta\.url\)""", text)
    return {(WEB / name).resolve() for name in from_root} | {(path.parent / name).resolve() for name in beside}


@pytest.mark.parametrize("path", SERVED, ids=address)
def test_a_file_comes_with_its_kind_and_the_pages_policy(client: TestClient, path: Path) -> None:
    answer = client.get(address(path))
    assert (answer.status_code, answer.content) == (200, path.read_bytes())
    assert answer.headers["content-type"] == KINDS[path.suffix]
    policy = answer.headers["content-security-policy"].split("; ")
    assert {"default-src 'none'", "script-src 'self'", "connect-src 'self'", "frame-ancestors 'none'"} <= set(policy)
    assert not any("unsafe" in part or "http" in part or "*" in part for part in policy)
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers["referrer-policy"] == "no-referrer"
    assert answer.headers["cache-control"] == "no-cache"
    again = client.get(address(path), headers={"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    assert again.headers["content-security-policy"] == answer.headers["content-security-policy"]


@pytest.mark.parametrize(
    "path",
    [
        "/web",
        "/web/",
        "/web/index.html",
        "/web/none.js",
        "/web/vendor",
        "/web/vendor/preact.d.ts",
        "/web/%2e%2e/app.py",
        "/web/..%2f..%2frequirements%2fservice.txt",
        f"/web/{ROOT / 'requirements/service.txt'}",
        "/web/%00.js",
        f"/web/{'x' * 5000}.js",
    ],
)
def test_nothing_else_is_served(client: TestClient, path: str) -> None:
    answer = client.get(path)
    assert (answer.status_code, answer.headers["content-type"]) == (404, PROBLEM)


def test_files_are_read_only(client: TestClient) -> None:
    answer = client.put("/web/app.js", content=b"")
    assert (answer.status_code, answer.headers["allow"]) == (405, "GET, HEAD, OPTIONS")


def test_every_file_that_is_named_exists_and_every_file_is_named() -> None:
    found, todo = set(), {WEB / PAGE}
    while todo:
        found |= todo
        named = {name for path in todo for name in references(path)}
        missing = [str(path) for path in named if not path.is_file()]
        assert missing == []
        todo = named - found
    assert {str(path) for path in found} == {str(path) for path in FILES if path.suffix not in CHECKED_ONLY}


def test_the_page_is_small() -> None:
    sizes = {address(path): path.stat().st_size for path in SERVED}
    assert sum(sizes.values()) < MOST_BYTES, sizes


def test_nothing_is_inline() -> None:
    text = (WEB / PAGE).read_text(encoding="utf-8")
    assert not re.search(r"<style|\sstyle=|\son\w+=|<script(?![^>]*\ssrc=)", text)


def test_the_pictures_of_the_page_are_there_and_small() -> None:
    sizes = {path.name: path.stat().st_size for path in pictures.IMAGES.iterdir()}
    assert set(sizes) == {picture.name for picture in pictures.PICTURES}, "run `make pictures`"
    assert max(sizes.values()) < pictures.MOST_BYTES
    pages = [pictures.ROOT / "README.md", *(pictures.ROOT / "docs").glob("*.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    assert [name for name in sizes if f"images/{name}" not in text] == []
