"""Threads follow what the process may use, not what the machine has."""

import os
from pathlib import Path

import pytest

from service.cores import available_cores

NAMED = len(os.sched_getaffinity(0))


def groups(root: Path, own: str, files: dict[str, str]) -> tuple[Path, Path]:
    """Where control groups would lie, and the file that names the process' own."""
    for name, text in files.items():
        path = root / "groups" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (root / "own").write_text(own)
    return root / "groups", root / "own"


@pytest.mark.parametrize(
    ("own", "files"),
    [
        ("0::/\n", {"cpu.max": "100000 100000\n"}),
        (
            "0::/pods/one\n",
            {"cpu.max": "max 100000\n", "pods/cpu.max": "150000 100000\n", "pods/one/cpu.max": "max 1\n"},
        ),
        (
            "4:memory:/a\n3:cpu,cpuacct:/a\n",
            {"cpu,cpuacct/a/cpu.cfs_quota_us": "50000", "cpu,cpuacct/a/cpu.cfs_period_us": "100000"},
        ),
        ("1:cpu:/of/the/host\n", {"cpu/cpu.cfs_quota_us": "100000", "cpu/cpu.cfs_period_us": "100000"}),
    ],
    ids=["version 2", "a pod's, above", "version 1", "version 1 seen from inside"],
)
def test_a_quota_of_one_cores_time_is_one_core(tmp_path: Path, own: str, files: dict[str, str]) -> None:
    assert available_cores(*groups(tmp_path, own, files)) == 1


@pytest.mark.parametrize(
    ("own", "files"),
    [
        ("0::/\n", {}),
        ("0::/\n", {"cpu.max": "max 100000\n"}),
        ("0::/\n", {"cpu.max": "what\n"}),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}),
        ("0::/\n", {"cpu.max": "6400000 100000\n"}),
    ],
    ids=["no file", "no quota", "not a quota", "version 1 without", "more than there is"],
)
def test_without_a_lower_quota_it_is_the_affinitys(tmp_path: Path, own: str, files: dict[str, str]) -> None:
    assert available_cores(*groups(tmp_path, own, files)) == NAMED


def test_without_control_groups_it_is_the_affinitys(tmp_path: Path) -> None:
    assert available_cores(tmp_path, tmp_path / "none") == NAMED
