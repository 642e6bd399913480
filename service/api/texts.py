"""Texts that must have a form, and say in words what it is where they do not have it."""

import math
import re
from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

MOST_LETTERS = 100
# JSON can escape them, and no database stores them; not in the patterns, for not all programs that read those know them
HALF_CHARACTER = re.compile(r"[\ud800-\udfff]")


@dataclass(frozen=True, slots=True)
class Worded:
    """Annotates a text of a pattern, without half characters: the document has the pattern, a fault the words."""

    pattern: str
    words: str

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._require, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {**handler(schema), "pattern": self.pattern}

    def _require(self, text: str) -> str:
        if not re.fullmatch(self.pattern, text) or HALF_CHARACTER.search(text):
            raise ValueError(self.words)
        return text


def numbers_in(text: str) -> tuple[float, ...]:
    """Finite numbers with commas between them. Raises ``ValueError`` for anything else, and for a text too long."""
    if len(text) > MOST_LETTERS:
        raise ValueError(f"at most {MOST_LETTERS} characters")
    numbers = tuple(map(float, text.split(",")))
    if not all(map(math.isfinite, numbers)):
        raise ValueError("no finite numbers")
    return numbers
