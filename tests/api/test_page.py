"""What a browser is given: complete without a network."""

import re

import pytest
from starlette.testclient import TestClient


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_a_page_loads_nothing_from_elsewhere_and_lacks_nothing(client: TestClient, path: str) -> None:
    page = client.get(path)
    assert page.status_code == 200
    assert page.headers["content-type"].startswith("text/html")
    loaded = re.findall(r'(?:src|<link[^>]*href)="([^"]+)"', page.text)
    assert not [address for address in loaded if "//" in address]
    assert {client.get(address).status_code for address in loaded} <= {200}


def test_the_page_leads_to_docs_that_show_the_description_the_app_serves(client: TestClient) -> None:
    assert 'href="docs"' in client.get("/").text
    assert "/openapi.json" in client.get("/docs").text
    assert "/depth" in client.get("/openapi.json").json()["paths"]
