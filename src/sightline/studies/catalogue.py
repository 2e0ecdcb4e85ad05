"""All studies by name."""

from sightline.common.names import named
from sightline.studies.budget import Budget
from sightline.studies.coverage import Coverage
from sightline.studies.fig13 import Figure13
from sightline.studies.frame_design import FrameDesignStudy
from sightline.studies.rendered.fig15 import Figure15
from sightline.studies.rendered.porcine import Porcine
from sightline.studies.rendered.register_bone import RegisterBone
from sightline.studies.runs.study import Study
from sightline.studies.table1 import Table1
from sightline.studies.wrong_plans import WrongPlans

_ALL: tuple[Study, ...] = (
    Table1(),
    Coverage(),
    Budget(),
    FrameDesignStudy(),
    Figure13(),
    Porcine(),
    Figure15(),
    WrongPlans(),
    RegisterBone(),
)
STUDIES: dict[str, Study] = {study.name: study for study in _ALL}


def study_called(name: str) -> Study:
    """Return the study of this name. Raises UnusableInputError, which lists all studies."""
    return named(name, STUDIES, "study")
