"""Run campaigns: `python -m campaigns [NAME ...] [--tries N] [--seed S]`; the same command resumes a stopped run.

Exit code 1 where a try ended in a defect.
"""

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from campaigns.campaign import called
from sightline.errors import UnusableInputError
from sightline.studies.runs.run import StudyRun

NAMES = ("points", "images", "files", "robots", "kills", "pages")
TRIES = 200  # of each campaign: minutes on two cores


def main() -> int:
    """Print a table for each campaign; return 1 if a try ended in a defect."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", choices=[[], *NAMES], help=f"of {', '.join(NAMES)}")
    parser.add_argument("--tries", type=int, default=TRIES, help="of each; more can be added later")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("out/campaign"), help="folder of finished tries")
    options = parser.parse_args()
    console, wrong = Console(width=180), False
    for name in options.names or NAMES:
        try:
            run = StudyRun.open(called(name), options.tries, options.seed, options.out / f"{name}-{options.seed}")
        except UnusableInputError as error:
            parser.error(str(error))
        with Progress(console=console, transient=True) as progress:
            bar = progress.add_task(name, total=len(run.missing))
            run.do(advance=lambda bar=bar, progress=progress: progress.advance(bar))
        summary = run.result().summary
        for each in summary.tables:
            table = Table(*each.columns, title=f"{name}: {each.title}")
            for row in each.rows:
                table.add_row(*row)
            console.print(table)
        console.print(*(f"- {finding}" for finding in summary.findings), sep="\n")
        wrong |= summary.findings != ("No defect.",)
    return int(wrong)


if __name__ == "__main__":
    sys.exit(main())
