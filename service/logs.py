"""Structured logs: one event a line on standard error, ours and the libraries' alike."""

import logging
import sys
from typing import Literal

import structlog
from rich.console import Console
from structlog.typing import Processor


def configure(level: str, style: Literal["console", "json"]) -> None:
    """Set up logging for this process; called once, by the command that serves."""
    shared: list[Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.stdlib.add_logger_name,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    structlog.configure(
        processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        logger_factory=structlog.stdlib.LoggerFactory(),
        wrapper_class=structlog.stdlib.BoundLogger,
        cache_logger_on_first_use=True,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(foreign_pre_chain=shared, processors=_rendered(style)))
    root = logging.getLogger()
    root.handlers = [handler]
    root.setLevel(level.upper())
    logging.captureWarnings(True)  # of Python's own
    logging.getLogger("alembic").setLevel(logging.WARNING)


def _rendered(style: Literal["console", "json"]) -> list[Processor]:
    strip = structlog.stdlib.ProcessorFormatter.remove_processors_meta
    if style == "json":
        return [strip, structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    terminal = Console(stderr=True)
    colors = terminal.is_terminal and not terminal.no_color
    # quoted: a terminal would do what the control characters in a stranger's words tell it
    shown = structlog.dev.ConsoleRenderer(
        colors=colors, repr_native_str=True, exception_formatter=structlog.dev.plain_traceback
    )
    return [strip, shown]
