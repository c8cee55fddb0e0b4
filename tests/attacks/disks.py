"""Disks that are full after some bytes of what a command writes, and then have room again."""

import ctypes
import os
import shutil
import sys
from functools import partial
from pathlib import Path
from random import Random

from attacks import Trial, child, command
from attacks.kills import COMMANDS, Whole, differing, made_by, prepare, whole
from attacks.material import Material

# Room for all that a command writes [bytes], and the steps in which a file system counts.
PLENTY, STEP = 2**28, 2**12
NEWNS, NEWUSER, PRIVATE, REMOUNT = 0x20000, 0x10000000, 0x44000, 0x20  # flags of Linux


def trials(material: Material, draw: Random, count: int) -> list[Trial]:
    """Returns trials in which less and less of what each command writes has room."""
    found, chosen = [], ("drive", "diagnose", "sweep")[:count]
    for place, name in enumerate(chosen):
        made, several = whole(material, name), len(range(place, count, len(chosen)))
        size = sum(p.stat().st_size for p in [made.path, *made.path.rglob("*")] if p.is_file())
        if name == "sweep":  # Ray takes most of its time
            several = max(several // 5, 1)
        for number in range(several):
            room = int(size * (number + draw.random()) / several) // STEP * STEP
            attempt = partial(_attempt, material, name, made, room)
            found.append(Trial(f"{name}, room for {room:,} of {size:,} bytes", attempt))
    return found


def _attempt(material: Material, name: str, made: Whole, room: int, folder: Path) -> str:
    """Gives a command on a small disk, which only the process that mounts it sees."""
    answer = child(partial(_filled, material, name, made, room, folder), folder, seconds=300)
    return answer.broke(ended=(0,)) or answer.out.strip()


def _filled(material: Material, name: str, made: Whole, room: int, folder: Path) -> None:
    """Prints what breaks where the disk is full, and after it has room again."""
    if not mounted(folder, PLENTY):
        return  # this machine lets nobody mount anything
    prepare(material, name, folder)
    used = shutil.disk_usage(folder).used
    mounted(folder, used + room, REMOUNT)
    work = command(*COMMANDS[name])
    full = child(work, folder)
    broke = full.broke(ended=(0, 1, 2))
    path = folder / made_by(name)
    missing = differing(path, made.path) if path.exists() else "nothing is made"
    if not broke and missing and "o space left" not in full.out + full.err:
        broke = f"{missing}, and not a word about it: {full.out[-300:]!r} {full.err!r}"
    mounted(folder, PLENTY, REMOUNT)
    broke = broke or child(work, folder).broke(ended=(0, 1))
    print(broke or differing(path, made.path))


def mounted(folder: Path, size: int, flags: int = 0) -> bool:
    """Mounts a disk of a size [bytes] for this process alone, or gives it another; False if it cannot."""
    libc = ctypes.CDLL(None, use_errno=True)
    if not flags and sys.platform == "linux":
        user, group = os.getuid(), os.getgid()
        if libc.unshare(NEWNS) and libc.unshare(NEWNS | NEWUSER) == 0:
            for name, text in (
                ("setgroups", "deny"), ("uid_map", f"0 {user} 1"), ("gid_map", f"0 {group} 1"),
            ):  # fmt: skip
                Path("/proc/self", name).write_text(text, encoding="ascii")
        libc.mount(b"none", b"/", None, PRIVATE, None)
    place, options = os.fsencode(folder), f"size={size}".encode()
    return libc.mount(b"tmpfs", place, b"tmpfs", flags, options) == 0
