"""The case: time of an entry, of an original, of opening and checking; against plain SQLite in both journal modes.

An entry is on the disk when `record` returns, so the disk dominates its time; plain SQLite shows Sightline's share.
"""

import json
import sqlite3
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.harness import Rows, spread, time_ms
from sightline.case.journal import Actor, Case, Kind

MAX_MS = 5.0  # at the median
IMAGE_BYTES = 2 * 1024**2  # 1024² of 16 bits


def run(quick: bool) -> Rows:
    """Return the rows of this benchmark; `quick` writes a tenth."""
    entries, rng, rows = 100 if quick else 1000, np.random.default_rng(5), Rows("case")
    beads = {"uv_px": 512 * rng.standard_normal((110, 2)), "covariance_px2": rng.standard_normal((110, 2, 2))}
    text = json.dumps({name: value.tolist() for name, value in beads.items()})
    with TemporaryDirectory(dir=Path.cwd()) as place:  # not /tmp, which may be in memory
        folder = Path(place)
        with Case.create(folder / "case") as case:
            entry = time_ms(lambda: case.record(Kind.DETECTED, beads, by=Actor.APP), entries)
            small = time_ms(lambda: case.record(Kind.CHANGED, {"number": 1}, by=Actor.SURGEON), entries)
            images = iter([rng.bytes(IMAGE_BYTES) for _ in range(12)])
            original = time_ms(lambda: case.keep(next(images), ".dcm"), 10)
        opened = time_ms(lambda: Case.open(folder / "case").close(), 1)[0]
        peers = {mode: _plain_ms(folder / f"{mode}.sqlite", mode, text, entries) for mode in ("TRUNCATE", "WAL")}
    peer, asked = ", ".join(f"{mode} {spread(ms, 'ms', '.2f')}" for mode, ms in peers.items()), f"median <= {MAX_MS} ms"
    for name, ms, beside in (("entry of 110 beads", entry, peer), ("small entry", small, "")):
        rows.add(f"{name}, median / 95 %", spread(ms, "ms", ".2f"), asked, np.median(ms) <= MAX_MS, peer=beside)
    rows.add(f"original of {IMAGE_BYTES >> 20} MiB, median / 95 %", spread(original, "ms", ".2f"))
    rows.number(f"opening and checking {2 * entries + 4} entries", opened, ".0f", "ms")
    return rows


def _plain_ms(file: Path, mode: str, text: str, times: int) -> np.ndarray:
    """Return the times, ms, of inserting the same text with plain SQLite."""
    db = sqlite3.connect(file, isolation_level=None)
    db.execute(f"PRAGMA journal_mode = {mode}").fetchall()
    db.execute("PRAGMA synchronous = FULL")
    db.execute("CREATE TABLE rows (number INTEGER PRIMARY KEY, text TEXT)")
    times_ms = time_ms(lambda: db.execute("INSERT INTO rows (text) VALUES (?)", (text,)), times)
    db.close()
    return times_ms
