"""Look the locked dependencies up among known vulnerabilities, and never call what was not looked up clean.

A known vulnerability exits with 1. A package that could not be looked up is named; with ``--strict`` that exits with 2.
Further arguments go to pip-audit (``-s osv`` asks another database).
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

LOCK = Path(__file__).with_name("dev.txt")
STRICT = "--strict"
# what pip-audit prints where a database does not answer, as opposed to where it was called wrongly
UNREACHABLE = ("ConnectionError", "ServiceError", "Timeout", "HTTPError", "connect to PyPI")


def main() -> int:
    """Run pip-audit over the lock, say what it found and what it did not look at; the exit code."""
    given = sys.argv[1:]
    is_strict = STRICT in given
    command: list[str | Path] = [sys.executable, "-m", "pip_audit", "--progress-spinner", "off", "--format", "json"]
    command += ["--disable-pip", "--require-hashes", "--requirement", LOCK, *(word for word in given if word != STRICT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if not done.stdout:
        reason = done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "pip-audit said nothing"
        if not any(word in done.stderr for word in UNREACHABLE):
            print(done.stderr, file=sys.stderr)
            return 2
        return not_audited(f"the database of vulnerabilities cannot be reached ({reason[:200]})", is_strict)
    packages: list[dict[str, Any]] = json.loads(done.stdout)["dependencies"]
    known = [(package, item) for package in packages for item in package.get("vulns", ())]
    for package, item in known:
        mended = ", ".join(item["fix_versions"]) or "no version"
        print(f"VULNERABLE: {package['name']} {package['version']}: {item['id']}, mended in {mended}")
    skipped = [package["name"] for package in packages if "skip_reason" in package]
    if len(skipped) < len(packages):
        print(f"{len(packages) - len(skipped)} of {len(packages)} packages looked up: {len(known)} vulnerabilities.")
    if known:
        return 1
    if skipped:
        return not_audited(f"the database does not know {len(skipped)} packages: {', '.join(skipped)[:200]}", is_strict)
    return 0


def not_audited(reason: str, is_strict: bool) -> int:
    """Say so where it cannot be overlooked."""
    print(f"{'*' * 80}\nNOT AUDITED: {reason}.\n{'*' * 80}", file=sys.stderr)
    return 2 if is_strict else 0


if __name__ == "__main__":
    sys.exit(main())
