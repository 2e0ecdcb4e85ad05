"""The program whose worker is held up as by compilation: python -m tests.app.held_app FILE ARGUMENTS...

The worker goes on once FILE is there.
"""

import sys
import time
from functools import partial
from pathlib import Path

from sightline.app.session import planning
from sightline.app.session.jobs import warm_up
from sightline.cli import main


def wait_and_warm_up(file: Path) -> None:
    while not file.exists():
        time.sleep(0.05)
    warm_up()


if __name__ == "__main__":
    from tests.app.held_app import wait_and_warm_up as of_the_worker  # which imports it by this name

    planning.warm_up = partial(of_the_worker, Path(sys.argv.pop(1)))
    main()
