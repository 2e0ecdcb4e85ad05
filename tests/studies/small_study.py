"""A study whose trials cost nothing, or their worker's life: for tests of the runner. Workers import it by its name."""

import os
import signal
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sightline.studies.runs.study import Summary, Table, Values, quantile


@dataclass(frozen=True)
class SmallStudy:
    """`spread` of its numbers; `seconds` a trial takes; `deadly`: a folder where each trial above `limit` dies once,
    or, with `always`, every time."""

    spread: float = 1.0
    seconds: float = 0.0
    deadly: str = ""
    limit: float = 1.0
    always: bool = False
    name: str = "small"
    about: str = "Numbers <from> nowhere"

    @property
    def configuration(self) -> dict[str, Any]:
        return asdict(self)

    def trial(self, rng: np.random.Generator) -> Values:
        value = float(rng.standard_normal())
        time.sleep(self.seconds)
        if self.deadly and value > self.limit:
            mark = Path(self.deadly) / f"{value:.12f}"
            if self.always or not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        return {"value": self.spread * value, "refused": None}

    def summary(self, trials: Sequence[Values]) -> Summary:
        middle = quantile("median", np.array([trial["value"] for trial in trials]), 0.5)
        return Summary((f"The median is {middle} <mm>.",), (middle,), (Table("Values", ("of",), ((str(middle),),)),))
