"""Processor cores this process may use."""

import math
import os
from collections.abc import Iterator
from pathlib import Path

GROUPS = Path("/sys/fs/cgroup")
OWN_GROUPS = Path("/proc/self/cgroup")


def available_cores(groups: Path = GROUPS, own_groups: Path = OWN_GROUPS) -> int:
    """As many as the affinity names, or as the control groups' quota of processor time is worth: the fewer.

    ``docker run --cpus`` and a pod's limit are such quotas; more threads than that only wait for each other.
    """
    named = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = min(_quotas(groups, own_groups), default=math.inf)
    return named if quota >= named else max(1, int(quota))


def _quotas(groups: Path, own_groups: Path) -> Iterator[float]:
    """What the process' control groups and those above them allow, in cores, of versions 1 and 2."""
    try:
        lines = own_groups.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if not controllers:
            mounts = [groups, groups / "unified"]
        elif "cpu" in controllers.split(","):
            mounts = [groups / controllers, groups / "cpu"]
        else:
            continue
        own = Path(path.lstrip("/"))
        for mount in mounts:
            for group in (own, *own.parents):
                yield from _quota_of(mount / group)


def _quota_of(group: Path) -> Iterator[float]:
    for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
        try:
            quota, period, *_ = " ".join((group / name).read_text() for name in names).split()
            if quota not in ("max", "-1"):
                yield int(quota) / int(period)
        except (OSError, ValueError, ZeroDivisionError):
            continue  # no such group, or none that limits time
