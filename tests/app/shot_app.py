"""The program that tells where its shots while drilling are taken: python -m tests.app.shot_app FILE ARGUMENTS...

FILE then holds the simulated wire and the joints at the last shot: what the twin needs to know the truth of its images.
"""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sightline.app.session.rehearsing import shot_images
from sightline.app.session.worker import WorkerProcess
from sightline.cli import main


def _telling(file: Path) -> None:
    do = WorkerProcess.do

    async def told(self: WorkerProcess, function: Callable[..., Any], *given: Any) -> Any:
        if function is shot_images:
            _, wires, q, *_ = given
            new = file.with_suffix(".new")
            new.write_text(json.dumps({"wire": list(wires.values())[-1], "q": q}))
            new.replace(file)
        return await do(self, function, *given)

    replaced: Any = told
    WorkerProcess.do = replaced


if __name__ == "__main__":
    _telling(Path(sys.argv.pop(1)))
    main()
