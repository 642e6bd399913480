"""``Prefer`` (RFC 7240): how long a client would wait for an answer."""

import re

WAIT = "wait"
MOST_WAIT_S = 60


def wait_of(prefer: str | None) -> int | None:
    """Seconds to wait, at most ``MOST_WAIT_S``; None without the preference, or where it is no number."""
    for preference in (prefer or "").split(","):
        name, _, value = preference.partition(";")[0].partition("=")
        if name.strip().lower() == WAIT:
            found = re.fullmatch(r"\"?(\d{1,9})\"?", value.strip(), re.ASCII)
            return min(int(found[1]), MOST_WAIT_S) if found else None
    return None
