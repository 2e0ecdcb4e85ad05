"""All texts of the page, in the language of the page: `texts.NAME` is a text of `english.py` in the spoken language.

Look a text up where it is shown, never when a module is imported: two pages may speak different languages.
"""

from typing import TYPE_CHECKING, Any

from sightline.app.texts.languages import ENGLISH as ENGLISH
from sightline.app.texts.languages import Language as Language
from sightline.app.texts.languages import in_progress as in_progress
from sightline.app.texts.languages import language_of as language_of
from sightline.app.texts.languages import load as load
from sightline.app.texts.languages import now as now
from sightline.app.texts.languages import said as said
from sightline.app.texts.languages import sentence as sentence
from sightline.app.texts.languages import spoken as spoken
from sightline.app.texts.languages import tag as tag
from sightline.app.texts.languages import tenths as tenths
from sightline.app.texts.languages import titled as titled
from sightline.app.texts.languages import word as word

if TYPE_CHECKING:
    from sightline.app.texts.english import *  # noqa: F403 - so that names and types are known


def __getattr__(name: str) -> Any:
    try:
        return now().texts[name]
    except KeyError:
        raise AttributeError(name) from None
