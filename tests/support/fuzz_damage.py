"""Bytes flipped, cut, swapped, doubled, blanked, words exchanged, huge counts; compressed files are damaged inside."""

from __future__ import annotations

import gzip
import io
import re
import zipfile

import numpy as np

HUGE = [b"\xff" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8, b"\xff" * 7 + b"\x7f", b"\x00" * 8]
NUMBERS = [b"0", b"-1", b"1e999", b"nan", b"4294967295", b"-2147483648", b"99999999999999999999", b"1.5", b"", b"x"]


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """The content of a file, damaged in one to three ways; the same generator gives the same damage."""
    if data[:2] == b"\x1f\x8b" and rng.random() < 0.6:
        return gzip.compress(damaged(gzip.decompress(data), rng), mtime=0)
    if data[:2] == b"PK" and rng.random() < 0.8:
        return _damaged_archive(data, rng)
    for _ in range(rng.integers(1, 4)):
        data = DAMAGE[rng.integers(len(DAMAGE))](data, rng)
    return data


def _damaged_archive(data: bytes, rng: np.random.Generator) -> bytes:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    names = sorted(entries)
    name = names[rng.integers(len(names))] if rng.random() < 0.6 or "header.npy" not in entries else "header.npy"
    how = rng.random()
    if how < 0.1:
        del entries[name]
    elif how < 0.2:
        entries[name] = entries[names[rng.integers(len(names))]]
    else:
        entries[name] = damaged(entries[name], rng)
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for each, content in entries.items():
            entry = zipfile.ZipInfo(each)  # without a date, so that it is the same each time
            entry.extra = bytes(-(out.tell() + 30 + len(each)) % 64)  # contents begin where USD requires
            archive.writestr(entry, content)
    return out.getvalue()


def _span(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(data) + 1))
    return start, min(start + int(2 ** rng.uniform(0, 10)), len(data))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    flipped = np.frombuffer(data, np.uint8).copy()
    if len(flipped):
        # Headers lie at the beginning.
        reach = len(flipped) if rng.random() < 0.5 else min(len(flipped), 200)
        where = rng.integers(reach, size=int(2 ** rng.uniform(0, 5)))
        flipped[where] ^= (1 << rng.integers(8, size=len(where))).astype(np.uint8)
    return flipped.tobytes()


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: rng.integers(len(data) + 1)]


def _without(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + data[end:]


def _doubled(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:end] + data[start:]


def _swapped(data: bytes, rng: np.random.Generator) -> bytes:
    (a, b), (c, d) = sorted((_span(data, rng), _span(data, rng)))
    return data if b > c else data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]


def _blanked(data: bytes, rng: np.random.Generator) -> bytes:
    start, end = _span(data, rng)
    return data[:start] + bytes([rng.integers(256)]) * (end - start) + data[end:]


def _huge(data: bytes, rng: np.random.Generator) -> bytes:
    """A huge number in place of a count in the text or among the first bytes."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:4000]))
    if found and rng.random() < 0.6:
        which = found[rng.integers(len(found))]
        return data[: which.start()] + NUMBERS[rng.integers(len(NUMBERS))] + data[which.end() :]
    value = HUGE[rng.integers(len(HUGE))]
    start = int(rng.integers(max(min(len(data), 2000 if rng.random() < 0.8 else len(data)), 1)))
    return data[:start] + value + data[start + len(value) :]


def _exchanged(data: bytes, rng: np.random.Generator) -> bytes:
    """A word or a number in place of another, so that a text remains text."""
    found = list(re.finditer(rb"[\w.+-]+", data[:4000]))
    if not found:
        return data
    one, other = (found[k] for k in rng.integers(len(found), size=2))
    return data[: one.start()] + other[0] + data[one.end() :]


DAMAGE = [_flip, _cut, _without, _doubled, _swapped, _blanked, _huge, _huge, _exchanged, _exchanged]
