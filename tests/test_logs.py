"""The log as it is shown."""

import io
import json
import subprocess
import sys

import pytest

from service import logs


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("shown_on", "no_color", "is_coloured"), [(Terminal, "", True), (Terminal, "1", False), (io.StringIO, "", False)]
)
def test_colours_are_a_terminal_s_where_they_are_wanted(
    monkeypatch: pytest.MonkeyPatch, shown_on: type[io.StringIO], no_color: str, is_coloured: bool
) -> None:
    monkeypatch.setattr(sys, "stderr", shown_on())
    monkeypatch.setenv("NO_COLOR", no_color)
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    *_, render = logs._rendered("console")
    assert ("\x1b" in str(render(None, "info", {"event": "asked", "level": "info"}))) == is_coloured


def test_what_was_sent_commands_no_terminal() -> None:
    *_, render = logs._rendered("console")
    line = str(render(None, "info", {"event": "request", "level": "info", "camera": "\x1b[2J\x9b\u202e\u2028"}))
    assert line.isprintable()
    assert r"camera='\x1b[2J\x9b\u202e\u2028'" in line


def test_a_warning_of_python_s_is_an_event_too() -> None:
    warning = "import warnings; from service import logs; logs.configure('info', 'json'); warnings.warn('two\\nlines')"
    done = subprocess.run([sys.executable, "-c", warning], capture_output=True, text=True, check=True)
    (line,) = done.stderr.splitlines()
    event = json.loads(line)
    assert (event["level"], event["logger"]) == ("warning", "py.warnings")
    assert "two\nlines" in event["event"]
