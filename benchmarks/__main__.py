"""Run the benchmarks: `python -m benchmarks [NAME ...] [--quick]`; names are files here without their `bench_`.

What is measured replaces the benchmark's entries in results.json, unless it is `--quick`. `--page` writes the recorded
values into docs/benchmarks.md.
"""

import argparse
import importlib
import os
import sys
import time

from rich.console import Console
from rich.table import Table

from benchmarks import results
from benchmarks.rows import Row


def _table(rows: list[Row]) -> Table:
    table = Table(show_lines=False)
    for column in ("group", "metric", "measured", "required", "peer", "met"):
        table.add_column(column)
    for row in rows:
        met = {True: "yes", False: "NO", None: ""}[row.met]
        table.add_row(row.group, row.name, row.value, row.required, row.peer, met)
    return table


def main() -> int:
    """Print the table; return 1 if a required value is not met."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is imported
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *results.names()])
    parser.add_argument(
        "--quick", action="store_true", help="a tenth of the trials: a quick check, not for publication"
    )
    parser.add_argument("--page", action="store_true", help="write the recorded values into docs/benchmarks.md")
    options = parser.parse_args()
    if options.page:
        results.PAGE.write_text(results.page())
        return 0
    console = Console(width=160)
    everything: list[Row] = []
    for name in options.names or results.names():
        started = time.perf_counter()
        module = importlib.import_module(f"benchmarks.bench_{name}")
        rows = module.run(quick=options.quick)
        everything += rows
        if not options.quick:
            results.update(name, rows, getattr(module, "FIRST_SEED", None))
        console.print(_table(rows))
        console.print(f"{name}: {time.perf_counter() - started:.0f} s")
    missed = [row for row in everything if row.met is False]
    console.print(f"{len(everything)} values, {len(missed)} not met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
