"""The OpenAPI document: FastAPI's, with our one error schema and the header every answer carries."""

import json
import re
from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.access import READING, is_public, needed_scope
from service.api.problems import PROBLEM_TYPE, STORE_ERRORS, Problem, responses
from service.api.uploads import BINARY
from service.errors import (
    CamindError,
    CrossOrigin,
    Forbidden,
    QuotaExceeded,
    ReceiveTimeout,
    TooLarge,
    Unauthorized,
    UnknownHost,
)

# words that YAML reads as truth values or nothing
YAML_WORDS = frozenset({"null", "true", "false", "yes", "no", "on", "off", "y", "n"})
REF = "#/components/schemas/{model}"
# what the limits in front of the routes answer
BODY_ERRORS = (ReceiveTimeout, TooLarge)
# what looking a key up in the database answers, or being asked without keys
KEY_ERRORS = (Unauthorized, QuotaExceeded, UnknownHost, *STORE_ERRORS)
API_KEY = "apiKey"
SECURITY = {
    "type": "http",
    "scheme": "bearer",
    "description": "An API key from `camind keys create`; not asked for where only the own machine reaches the service",
}
# of no type: OpenAPI 3.1 knows no items of a stream, and some take the schema for that of one event, others of all
EVENTS = {"description": "Events, the data of each a `CalibrationRead` in JSON"}
FRAMEWORK_SCHEMAS = ("HTTPValidationError", "ValidationError")
REQUEST_ID_REF = {"$ref": "#/components/headers/RequestId"}
REQUEST_ID = {
    "description": "The request's id: the one sent, or a new one; the log has it too",
    "schema": {"type": "string"},
}


def describe(app: FastAPI) -> dict[str, Any]:
    """The app's OpenAPI document, built once."""
    if app.openapi_schema is None:
        document = get_openapi(
            title=app.title,
            version=app.version,
            summary=app.summary,
            description=app.description,
            routes=app.routes,
            tags=app.openapi_tags,
            servers=[{"url": "/"}],
            license_info=app.license_info,
        )
        _add_components(document)
        for path, operations in document["paths"].items():
            for method, operation in operations.items():
                if is_public(path):
                    operation["security"] = []
                else:
                    _secure(operation, method.upper(), path)
                _complete(operation)
        app.openapi_schema = document
    return app.openapi_schema


def _add_components(document: dict[str, Any]) -> None:
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    for name in FRAMEWORK_SCHEMAS:
        schemas.pop(name, None)
    problem = Problem.model_json_schema(ref_template=REF)
    schemas.update(problem.pop("$defs", {}))
    schemas["Problem"] = problem
    for schema in schemas.values():
        if "prefixItems" in schema:  # pairs of one kind: not every program knows of prefixItems
            schema["items"] = {"type": schema["prefixItems"][0]["type"]}
    components["headers"] = {"RequestId": REQUEST_ID}
    components["securitySchemes"] = {API_KEY: SECURITY}


def _complete(operation: dict[str, Any]) -> None:
    # the framework assumes its own 422 wherever a route takes a parameter and documents none
    if "HTTPValidationError" in str(operation["responses"].get("422", "")):
        del operation["responses"]["422"]
    for parameter in operation.get("parameters", ()):
        parameter["schema"] = _without_null(parameter["schema"])
    if "requestBody" in operation:
        _add_errors(operation, *BODY_ERRORS)
    for answer in operation["responses"].values():
        for content in answer.get("content", {}).values():
            if content.pop("itemSchema", None):
                content["schema"] = EVENTS
            content.setdefault("schema", BINARY)  # without one clients throw the file away
        answer.setdefault("headers", {})["X-Request-Id"] = REQUEST_ID_REF


def _secure(operation: dict[str, Any], method: str, path: str) -> None:
    """Say that a key is asked for, or none (``{}``), which scope it needs, and what happens without."""
    scope = needed_scope(method, path)
    operation["security"] = [{API_KEY: [scope] if scope else []}, {}]
    _add_errors(operation, *KEY_ERRORS)
    if scope:
        _add_errors(operation, Forbidden)
    if method not in READING:
        _add_errors(operation, CrossOrigin)


def _add_errors(operation: dict[str, Any], *errors: type[CamindError]) -> None:
    """Document these too; of a status that the route has itself they are further examples."""
    for status, answer in responses(*errors).items():
        known = operation["responses"].setdefault(str(status), answer)["content"][PROBLEM_TYPE]["examples"]
        known.update(answer["content"][PROBLEM_TYPE]["examples"])


def _without_null(schema: dict[str, Any]) -> dict[str, Any]:
    """The schema of a parameter, which is left out where a body's field would be null."""
    kinds = [kind for kind in schema.get("anyOf", ()) if kind != {"type": "null"}]
    if len(kinds) != 1:
        return schema
    return {**kinds[0], **{key: value for key, value in schema.items() if key != "anyOf"}}


def to_yaml(document: object) -> str:
    """JSON data as YAML in block style; scalars are written as JSON, which YAML reads alike."""
    return "\n".join(_lines(document, 0)) + "\n"


def _lines(value: object, depth: int) -> Iterator[str]:
    indent = "  " * depth
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from _entry(f"{indent}{_key(str(key))}:", item, depth + 1)
    elif isinstance(value, list) and value:
        for item in value:
            yield from _entry(f"{indent}-", item, depth + 1)
    else:
        yield indent + _scalar(value)


def _entry(head: str, item: object, depth: int) -> Iterator[str]:
    if isinstance(item, dict | list) and item:
        yield head
        yield from _lines(item, depth)
    else:
        yield f"{head} {_scalar(item)}"


def _scalar(value: object) -> str:
    text = json.dumps(value, ensure_ascii=False)
    # without a point, 1e-06 is a word to readers of YAML 1.1
    return text.replace("e", ".0e") if isinstance(value, float) and "." not in text else text


def _key(text: str) -> str:
    is_plain = re.fullmatch(r"[$/A-Za-z][\w${}/.-]*", text) and text.lower() not in YAML_WORDS
    return text if is_plain else json.dumps(text, ensure_ascii=False)
