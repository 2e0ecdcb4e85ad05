"""Run the benchmarks: `python -m benchmarks [NAME ...] [--quick]`; names are files here without their `bench_`.

What is measured replaces the benchmark's entries in results.json, unless it is `--quick`. `--page` writes the recorded
values into docs/benchmarks.md.
"""

import argparse
import importlib
import sys
import time

from rich.console import Console
from rich.table import Table

from benchmarks import results


def main() -> int:
    """Print the tables; return 1 if a required value is not met."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *results.names()])
    parser.add_argument("--quick", action="store_true", help="a tenth of the trials: a check, not for publication")
    parser.add_argument("--page", action="store_true", help="write the recorded values into docs/benchmarks.md")
    options = parser.parse_args()
    if options.page:
        results.PAGE.write_text(results.page())
        return 0
    console, missed, number = Console(width=160), 0, 0
    for name in options.names or results.names():
        started = time.perf_counter()
        module = importlib.import_module(f"benchmarks.bench_{name}")
        rows = module.run(quick=options.quick)
        if not options.quick:
            results.update(name, rows, getattr(module, "FIRST_SEED", None))
        table = Table("group", "metric", "measured", "asked", "peer", "met")
        for row in rows:
            met = {True: "yes", False: "NO", None: ""}[row.met]
            table.add_row(row.group, row.name, f"{row.value} {row.unit}".strip(), row.asked, row.peer, met)
        console.print(table, f"{name}: {time.perf_counter() - started:.0f} s")
        missed, number = missed + sum(row.met is False for row in rows), number + len(rows)
    console.print(f"{number} values, {missed} not met")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
