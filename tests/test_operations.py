"""What the operator's pages say is so: every setting, every error, every test that they name."""

import ast
import re
from pathlib import Path
from typing import Literal, get_args, get_origin

from annotated_types import Ge, Gt, Le
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from service import server
from service.api.problems import TYPE_PREFIX
from service.config import ENV_PREFIX, SHIPPED_MODEL, Settings
from service.errors import CamindError

ROOT = Path(__file__).parents[1]
OPERATIONS = (ROOT / "docs" / "operations.md").read_text()
SECURITY = (ROOT / "SECURITY.md").read_text()
# defaults that are worked out when the service starts
WORKED_OUT = {
    "data_dir": "`~/.local/share/camind`",
    "model_dir": "the shipped model",
    "otlp_endpoint": "`OTEL_EXPORTER_OTLP_ENDPOINT`",
}
SIGNS = {Ge: "≥", Gt: ">", Le: "≤"}


def errors(base: type[CamindError] = CamindError) -> list[type[CamindError]]:
    return [base] + [error for each in base.__subclasses__() for error in errors(each)]


def rows_below(heading: str, page: str = OPERATIONS) -> dict[str, list[str]]:
    """The cells of the table under a heading, by their first."""
    section = page.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    lines = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in section.splitlines() if "|" in line]
    return {cells[0].strip("`"): cells[1:] for cells in lines[2:]}


def settings_row(name: str, field: FieldInfo) -> str:
    return f"| `{ENV_PREFIX}{name.upper()}` | {_default(name, field)} | {_bounds(field)} | {field.description} |"


def _default(name: str, field: FieldInfo) -> str:
    if name in WORKED_OUT:
        assert field.default is PydanticUndefined or field.default == SHIPPED_MODEL
        return WORKED_OUT[name]
    value = field.default
    return f"`{value:g}`" if isinstance(value, float) else f"`{value}`" if value != "" else "empty"


def _bounds(field: FieldInfo) -> str:
    if get_origin(field.annotation) is Literal:
        return ", ".join(f"`{value}`" for value in get_args(field.annotation))
    found = []
    for bound in field.metadata:
        sign = SIGNS.get(type(bound))
        if sign is not None:
            (value,) = (getattr(bound, slot) for slot in bound.__slots__ if hasattr(bound, slot))
            found.append(f"{sign} {value}")
    return ", ".join(found) or "any"


def test_every_setting_is_listed_with_its_default_and_bounds() -> None:
    wanted = [settings_row(name, field) for name, field in Settings.model_fields.items()]
    found = [line for line in OPERATIONS.splitlines() if line.startswith(f"| `{ENV_PREFIX}")]
    assert found == wanted, "the table is:\n" + "\n".join(wanted)


def test_every_error_is_listed_with_its_cause_and_remedy() -> None:
    assert issubclass(server.MalformedRequest, CamindError)
    rows = rows_below("Errors")
    assert {name: int(cells[0]) for name, cells in rows.items()} == {error.code: error.status for error in errors()}
    assert all(cause and remedy for _, cause, remedy in rows.values())
    assert TYPE_PREFIX in OPERATIONS


def test_every_metric_is_listed() -> None:
    named = re.findall(r"camind_\w+", str(list(rows_below("Metrics"))))
    source = (ROOT / "service" / "api" / "metrics.py").read_text()
    kept = set(re.findall(r'"(camind_\w+)"', source))
    assert {name.removesuffix("_total").removesuffix("_info") for name in named} == kept


def test_every_event_of_the_log_is_listed() -> None:
    named = re.findall(r"`(\w+)`", " ".join(f"`{name}`" for name in rows_below("Log")))
    sources = [path.read_text() for path in (ROOT / "service").rglob("*.py")]
    assert sorted(named) == sorted({event for text in sources for event in re.findall(r'log\.\w+\(\s*"(\w+)"', text)})


def test_every_test_that_is_named_exists() -> None:
    named = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", OPERATIONS + SECURITY)
    assert len(named) > 10
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text())
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{path}::{name}"


def test_all_ten_risks_have_a_line() -> None:
    assert {row.split(":")[0] for row in rows_below("OWASP API Security Top 10 (2023)", SECURITY)} == {
        f"API{number}" for number in range(1, 11)
    }
