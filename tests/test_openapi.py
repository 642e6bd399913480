"""openapi.yaml is the app's, whole, and says of every route what it answers."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
import yaml
from fastapi import FastAPI
from httpx2 import Response
from jsonschema_rs import is_valid
from starlette.testclient import TestClient

from service.api.openapi import to_yaml
from service.api.problems import PROBLEM_TYPE
from tests.inference.photographs import corners, jpeg

COMMITTED = Path(__file__).parents[1] / "openapi.yaml"
METHODS = {"get", "put", "post", "delete", "patch"}


@pytest.fixture
def document(app: FastAPI) -> dict[str, Any]:
    return app.openapi()


def operations(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"{method} {path}", operation)
        for path, item in document["paths"].items()
        for method, operation in item.items()
        if method in METHODS
    ]


def problems_of(operation: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The examples of its problems, by status and code."""
    contents = {status: answer.get("content", {}) for status, answer in operation["responses"].items()}
    return {
        status: content[PROBLEM_TYPE]["examples"] for status, content in contents.items() if PROBLEM_TYPE in content
    }


def test_the_committed_file_is_the_app_s(document: dict[str, Any]) -> None:
    assert COMMITTED.read_text(encoding="utf-8") == to_yaml(document), "run `make openapi` and commit the file"


def test_the_file_is_yaml_of_the_same_content(document: dict[str, Any]) -> None:
    assert yaml.safe_load(to_yaml(document)) == document


@pytest.mark.parametrize(
    "value",
    [
        {},
        [],
        {"a": []},
        [[1, [2]], {"b": {}}],
        "yes",
        {"on": "off", "1": None, "a: b": "x #y", "": 1.5, "x": [1e-6, 1e30, -2.5e-9, 3.0], "~": True},
    ],
)
def test_yaml_reads_back_what_was_written(value: object) -> None:
    assert yaml.safe_load(to_yaml(value)) == value


def test_errors_are_documented_as_problems_with_examples(document: dict[str, Any]) -> None:
    for name, operation in operations(document):
        errors = {code: answer for code, answer in operation["responses"].items() if int(code) >= 400}
        assert "500" in errors, name
        for code, answer in errors.items():
            content = answer["content"]["application/problem+json"]
            assert content["schema"] == {"$ref": "#/components/schemas/Problem"}
            assert content["examples"], (name, code)
            for example in content["examples"].values():
                assert example["value"]["status"] == int(code)


def test_what_takes_a_camera_documents_its_absence(document: dict[str, Any]) -> None:
    for name, operation in operations(document):
        if "{name}" in name or name == "post /depth":
            assert "404" in operation["responses"], name


def test_what_takes_a_body_documents_its_limits(document: dict[str, Any]) -> None:
    for name, operation in operations(document):
        if "requestBody" in operation:
            assert {"408", "413", "415", "422"} <= set(operation["responses"]), name


def test_what_asks_for_a_key_documents_that_none_can_be_looked_up(document: dict[str, Any]) -> None:
    for name, operation in operations(document):
        if operation["security"]:
            assert {"busy", "not-ready"} <= problems_of(operation)["503"].keys(), name


def test_what_changes_something_documents_that_other_pages_may_not_and_what_reads_does_not(
    document: dict[str, Any],
) -> None:
    for name, operation in operations(document):
        assert ("cross-origin" in problems_of(operation).get("403", {})) != name.startswith("get "), name


def test_what_is_answered_is_as_its_example(client: TestClient, document: dict[str, Any], d200: dict[str, Any]) -> None:
    key, photograph = {"Idempotency-Key": "k"}, jpeg(corners(480, 640))
    client.post("/cameras", json=d200)
    client.post("/cameras", json=d200 | {"name": "other"}, headers=key)
    for _ in range(2):
        client.put("/cameras/d200", json=d200)

    def depth(content: bytes, **headers: str) -> Response:
        return client.post("/depth?camera=d200", content=content, headers={"Content-Type": "image/jpeg", **headers})

    answers = [
        client.post("/cameras", json=d200),
        client.post("/cameras", json=d200 | {"lens": d200["lens"] | {"focal_length_mm": 0}}),
        client.post("/cameras", json=d200 | {"name": "third"}, headers=key),
        client.post("/cameras", content="d200", headers={"Content-Type": "text/plain"}),
        client.put("/cameras/d200", json=d200, headers={"If-Match": '"2"'}),
        client.delete("/cameras/d200", headers={"Origin": "http://elsewhere.example"}),
        client.get("/cameras", headers={"Host": "elsewhere.example"}),
        depth(photograph),
        depth(photograph[:-2000]),
        depth(photograph, Accept="text/csv"),
        client.delete("/cameras/d200"),
        client.get("/cameras/d200"),
    ]
    examples = {
        code: example["value"]
        for _, operation in operations(document)
        for problems in problems_of(operation).values()
        for code, example in problems.items()
    }
    refusals = [answer.json() for answer in answers if answer.status_code >= 400]
    assert len({refusal["type"] for refusal in refusals}) == 11
    for refusal in refusals:
        assert refusal == examples[refusal["type"].removeprefix("urn:camind:problem:")]


def test_operation_ids_are_plain_and_unique(document: dict[str, Any]) -> None:
    ids = [operation["operationId"] for _, operation in operations(document)]
    assert len(set(ids)) == len(ids)
    assert all(operation_id.isalpha() for operation_id in ids)


def test_no_parameter_is_null(document: dict[str, Any]) -> None:
    for name, operation in operations(document):
        assert "'null'" not in str(operation.get("parameters")), name


def test_no_parameter_is_an_address(document: dict[str, Any]) -> None:
    names = {
        parameter["name"] for _, operation in operations(document) for parameter in operation.get("parameters", ())
    }
    assert names
    assert not [name for name in names if re.search("url|uri|href|host|callback|webhook|path|file", name)]
    assert not re.search("'format': '(uri|hostname|ipv)", str(document))


def test_the_framework_s_own_errors_are_nowhere(document: dict[str, Any]) -> None:
    assert "HTTPValidationError" not in str(document)


def test_every_reference_leads_somewhere(document: dict[str, Any]) -> None:
    def references(value: object) -> list[str]:
        if isinstance(value, dict):
            own = [value["$ref"]] if isinstance(value.get("$ref"), str) else []
            return own + [found for item in value.values() for found in references(item)]
        return [found for item in value for found in references(item)] if isinstance(value, list) else []

    for reference in references(document):
        _, section, kind, name = reference.split("/")
        assert name in document[section][kind], reference


def test_what_makes_clients_of_it_misreads_nothing(document: dict[str, Any]) -> None:
    assert "itemSchema" not in json.dumps(document)  # of OpenAPI 3.2
    schemas = document["components"]["schemas"]
    for name in ("CameraCreate", "CameraReplace"):  # some make types of each choice, or fail at a null in one
        assert not {"oneOf", "anyOf", "allOf", "not"} & schemas[name].keys()
    assert schemas["PointRead"]["properties"]["u"]["type"] == "number"  # a choice of numbers becomes a class
    assert schemas["Interval"]["items"] == {"type": "number"}  # not all know of prefixItems
    assert "minItems" not in json.dumps(document["paths"])  # Go's does not compile: a required field is there anyway
    (form,) = document["paths"]["/calibrate"]["post"]["requestBody"]["content"].values()  # of a copy they make a type
    assert form["schema"]["properties"]["settings"] == {"$ref": "#/components/schemas/CalibrationSettings"}
    errors = schemas["Problem"]["properties"]["errors"]
    assert "null" not in json.dumps(errors)
    assert "default" not in errors


def test_clients_made_of_it_hand_out_every_answer_and_send_forms(document: dict[str, Any]) -> None:
    binary = {"type": "string", "format": "binary"}
    for name, operation in operations(document):
        for answer in operation["responses"].values():
            for media_type, content in answer.get("content", {}).items():
                schema = content["schema"]  # without one a method returns nothing
                assert media_type.endswith("json") or media_type.startswith("text/") or schema == binary, name
                assert not media_type.startswith("text/") or schema.get("type") in ("string", None), name
        sent = list(operation.get("requestBody", {"content": {}})["content"])
        assert "multipart/form-data" not in sent[1:], name


def test_every_operation_says_whether_it_asks_for_a_key(document: dict[str, Any]) -> None:
    public = {name for name, operation in operations(document) if operation["security"] == []}
    assert public == {"get /health/live", "get /health/ready"}


@pytest.mark.parametrize(
    ("how", "is_allowed"),
    [
        ({"k_cam_px": 3}, True),
        ({"k_cam_px": 3, "lens": None}, True),
        ({"lens": {}}, True),
        ({"lens": {}, "k_cam_px": None}, True),
        ({"lens": {}, "k_cam_px": 3}, False),
        ({"lens": None, "k_cam_px": None}, False),
        ({"lens": None}, False),
        ({}, False),
    ],
)
def test_a_camera_has_either_k_cam_or_a_lens(
    client: TestClient, document: dict[str, Any], d200: dict[str, Any], how: dict[str, Any], is_allowed: bool
) -> None:
    told = {name: d200["lens"] if value == {} else value for name, value in how.items()}
    body = {name: value for name, value in d200.items() if name not in ("lens", "k_cam_px")} | told
    schema = {"$ref": "#/components/schemas/CameraCreate", "components": document["components"]}
    assert is_valid(schema, body) == is_allowed
    assert (client.post("/cameras", json=body).status_code == 201) == is_allowed
