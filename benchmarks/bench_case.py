"""The case: time of an entry, of an original, of opening and checking; against plain SQLite in both journal modes.

An entry is on the disk when `record` returns, so the disk dominates its time; plain SQLite shows Sightline's share.
"""

import json
import sqlite3
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row
from sightline.case.journal import Actor, Case, Kind

MEDIAN_MS = 5.0
IMAGE_BYTES = 2 * 1024**2  # 1024² of 16 bits


def run(quick: bool) -> list[Row]:
    """Return the rows of this benchmark; `quick` writes a tenth."""
    entries = 100 if quick else 1000
    with TemporaryDirectory(dir=Path.cwd()) as place:  # not /tmp, which may be in memory
        folder = Path(place)
        rng = np.random.default_rng(5)
        with Case.create(folder / "case") as case:
            beads = {"uv_px": 512 * rng.standard_normal((110, 2)), "covariance_px2": rng.standard_normal((110, 2, 2))}
            entry = _ms(entries, lambda _: case.record(Kind.DETECTED, beads, by=Actor.APP))
            small = _ms(entries, lambda k: case.record(Kind.CHANGED, {"number": k}, by=Actor.SURGEON))
            images = [rng.bytes(IMAGE_BYTES) for _ in range(10)]
            kept = _ms(len(images), lambda k: case.keep(images[k], ".dcm"))
        started = time.perf_counter()
        Case.open(folder / "case").close()
        opened = time.perf_counter() - started
        text = json.dumps({name: value.tolist() for name, value in beads.items()})
        peers = {name: _plain(folder / f"{name}.sqlite", name, text, entries) for name in ("TRUNCATE", "WAL")}
    peer = ", ".join(f"{name} {_said(times)}" for name, times in peers.items())
    required = f"<= {MEDIAN_MS:g} ms at the median"
    size = f"{IMAGE_BYTES >> 20} MiB"
    return [
        Row(
            "case",
            "entry of 110 beads, median / 95 %",
            _said(entry),
            required,
            peer,
            float(np.median(entry)) <= MEDIAN_MS,
        ),
        Row("case", "small entry, median / 95 %", _said(small), required, "", float(np.median(small)) <= MEDIAN_MS),
        Row("case", f"original of {size}, median / 95 %", _said(kept)),
        Row("case", f"opening and checking {2 * entries} entries", f"{1e3 * opened:.0f} ms"),
    ]


def _ms(times: int, do: Callable[[int], object]) -> np.ndarray:
    """Return wall times, ms, because a sync is waiting time."""
    out = np.empty(times)
    for k in range(times):
        started = time.perf_counter()
        do(k)
        out[k] = 1e3 * (time.perf_counter() - started)
    return out


def _plain(file: Path, mode: str, text: str, times: int) -> np.ndarray:
    """Return the times, ms, of inserting the same text with plain SQLite."""
    db = sqlite3.connect(file, isolation_level=None)
    db.execute(f"PRAGMA journal_mode = {mode}").fetchall()
    db.execute("PRAGMA synchronous = FULL")
    db.execute("CREATE TABLE rows (number INTEGER PRIMARY KEY, text TEXT)")
    out = _ms(times, lambda k: db.execute("INSERT INTO rows VALUES (?, ?)", (k, text)))
    db.close()
    return out


def _said(times_ms: np.ndarray) -> str:
    return f"{np.median(times_ms):.2f} / {np.quantile(times_ms, 0.95):.2f} ms"
