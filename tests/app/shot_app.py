"""The program that tells where its shots while drilling are taken: python -m tests.app.shot_app FILE ARGUMENTS...

FILE then holds the simulated wire and the joints at the last shot: what the twin needs to know the truth of its images.
"""

import json
import sys
from pathlib import Path
from typing import Any

from sightline.app.session.shots import Shots
from sightline.cli import main


def _telling(file: Path) -> None:
    taken = Shots.take_rehearsed

    async def told(self: Shots) -> None:
        robot = self._drilling.session
        if robot is not None:
            wire, q = await robot.simulated_wire(), await robot.joints()
            new = file.with_suffix(".new")
            new.write_text(json.dumps({"wire": wire.text(), "q": q.tolist()}))
            new.replace(file)
        await taken(self)

    replaced: Any = told
    Shots.take_rehearsed = replaced


if __name__ == "__main__":
    _telling(Path(sys.argv.pop(1)))
    main()
