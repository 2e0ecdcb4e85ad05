"""Languages of the page: English in `english.py`, each other one in a JSON file with the same keys.

A file has `language` (as in HTML's `lang`), `texts` (by the names in `english.py`), `words` (names that the rooms below
give in English, such as those of points, by the English ones) and `checks` (by name: what it is called, and the first
thing to do when it fails). What a file lacks is shown in English.
"""

import re
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from string import Formatter
from typing import Any

from pydantic import BaseModel, ConfigDict

from sightline.app.texts import english
from sightline.bounded import read_text
from sightline.checks import Check
from sightline.errors import UnusableInputError
from sightline.strict import read_strictly

_FOLDER = Path(__file__).parent
_MAX_BYTES = 1 << 20  # [ours] of a language file; the shipped one has 60 kB
_LISTED_CHARS = 12  # of a text with placeholders; sentences are not recognised by shorter ones [ours]
_POINT = re.compile(r"The lines of sight of (?:the )?(.+?) pass ")  # the point that a gap is of
_OF_POINT = " ({point})"  # after the name of a check
_VIEWS = re.compile(r"^(?:lateral|oblique)(?=: )|\bpa\b")  # of a view, in the sentence of a check


@dataclass(frozen=True, eq=False)
class Language:
    """A language: its tag as in HTML's `lang`, all texts by name, and its words and checks by their English names."""

    tag: str
    texts: Mapping[str, Any]
    words: Mapping[str, str]
    checks: Mapping[str, tuple[str, str]]

    @property
    def _named_checks(self) -> Iterator[tuple[str, str]]:
        """Names of checks, also with a point, and the first thing to do."""
        return ((f"{name}{of}", do) for name, do in self.checks.values() for of in ("", _OF_POINT))

    @cached_property
    def listed(self) -> re.Pattern[str]:
        """Matches what this language's file can have made of whole texts."""
        texts = [*_leaves(self.texts), *self.words.values(), *(f"{name}: {do}" for name, do in self._named_checks)]
        shapes = {_shape(text) for text in texts}
        return re.compile("|".join(filter(None, shapes)), re.DOTALL)


class _File(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

    language: str
    texts: dict[str, Any] = {}
    words: dict[str, str] = {}
    checks: dict[str, tuple[str, str]] = {}


_ADVICE = {
    "extra_forbidden": "is not a key of a language file; remove it",
    "finite_number": "is not a number; write it as text",
    "missing": "is missing; add it",
    "string_type": "is not a text; write it in quotes",
}


def _english() -> dict[str, Any]:
    return {name: value for name, value in vars(english).items() if name.isupper()}


ENGLISH = Language("en", _english(), {}, {})
_spoken: ContextVar[Language] = ContextVar("language", default=ENGLISH)


def now() -> Language:
    """Return the language that is spoken here: of the page whose part is drawn, or of the program."""
    return _spoken.get()


@contextmanager
def spoken(language: Language) -> Generator[None]:
    """Speak a language in this context, and in tasks that begin in it."""
    before = _spoken.set(language)
    try:
        yield
    finally:
        _spoken.reset(before)


def word(text: str) -> str:
    """Return a name that is given in English, in the spoken language; the name itself where it is not in the list. A
    number at its end stays, and so does a capital at its beginning."""
    language = now()
    if text in language.words:
        return language.words[text]
    if text in language.checks:  # a metric has the name of its check
        return language.checks[text][0]
    if (found := language.words.get(text[:1].lower() + text[1:])) is not None:
        return titled(found)
    name, _, number = text.rpartition(" ")
    return f"{word(name)} {number}" if name and number.isdigit() else text


def said(check: Check) -> str:
    """Return what a check says: in English its sentence; else its name, and of a failed one the first thing to do. The
    point of a gap is named."""
    known = now().checks.get(check.name)
    if known is None:
        return sentence(check)
    name, do = known
    if of := _POINT.match(check.sentence):
        name += _OF_POINT.format(point=word(of[1]))
    return name if check.passed else f"{name}: {do}"


def sentence(check: Check) -> str:
    """Return the sentence of a check, with the names of its views as a person writes them: "PA" for "pa"."""
    return _VIEWS.sub(lambda found: "PA" if found[0] == "pa" else titled(found[0]), check.sentence)


def tenths(value: float) -> str:
    """Return a value with one decimal, as text; zero without a sign."""
    return f"{round(value, 1) + 0.0:.1f}"


def titled(text: str) -> str:
    """Return a text that begins with a capital."""
    return text[:1].upper() + text[1:]


def in_progress(work: str) -> str:
    """Return a note that work, named in English, is in progress."""
    return f"{titled(word(work))} …"


def tag(sentence: str) -> str:
    """Return the language of a sentence, as HTML's `lang`: "en" for one that is not in the spoken language; else
    empty."""
    language = now()
    return "" if language.tag == ENGLISH.tag or language.listed.fullmatch(sentence) else ENGLISH.tag


def language_of(header: str | None) -> Language:
    """Return the shipped language that a browser prefers, by its header Accept-Language; else English."""
    for part in (header or "").split(","):  # browsers list them by preference
        key = part.partition(";")[0].strip().partition("-")[0].lower()
        if key == ENGLISH.tag:
            break
        if key.isalpha() and (_FOLDER / f"{key}.json").exists():
            return load(key)
    return ENGLISH


def load(ref: str) -> Language:
    """Return a language by its tag, as shipped, or from a file. Raises UnusableInputError."""
    if ref == ENGLISH.tag:
        return ENGLISH
    shipped = sorted(file.stem for file in _FOLDER.glob("*.json"))
    file = _FOLDER / f"{ref}.json" if ref in shipped else Path(ref)
    if not file.exists():
        raise UnusableInputError(f"no language {ref}: give en, {', '.join(shipped)}, or a language file")
    text = read_text(file, _MAX_BYTES, UnusableInputError, "give a language file")
    given = read_strictly(text, _File, UnusableInputError, _ADVICE)
    try:
        return Language(given.language, _merged("texts", ENGLISH.texts, given.texts), given.words, given.checks)
    except ValueError as error:
        raise UnusableInputError(f"correct the language file {file.name}: {error}") from error


def _merged(where: str, english: Any, given: Any) -> Any:
    """Return a text in another language, in English where it is not given. Raises ValueError if the shapes or the
    placeholders differ."""
    if given is None:
        return english
    if isinstance(english, str) and isinstance(given, str):
        if placeholders(given) != placeholders(english):
            raise ValueError(f"{where} needs the placeholders {', '.join(sorted(placeholders(english))) or 'none'}")
        return given
    if isinstance(english, dict) and isinstance(given, dict):
        if unknown := sorted(set(given) - set(english)):
            raise ValueError(f"{where} has no part {unknown[0]}")
        return {key: _merged(str(key), text, given.get(key)) for key, text in english.items()}
    if isinstance(english, tuple) and isinstance(given, list) and len(given) == len(english):
        return tuple(_merged(where, *pair) for pair in zip(english, given, strict=True))
    raise ValueError(f"{where} has another shape than in English")


def placeholders(text: str) -> set[str]:
    """Return the placeholders of a text with their formats, such as "age:.1f"."""
    return {f"{name}:{form}" if form else name for _, name, form, _ in Formatter().parse(text) if name is not None}


def _leaves(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    else:
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _leaves(part)


def _shape(text: str) -> str:
    """Return a pattern of all that a text can become; empty where that is too much to recognise it."""
    literal = [part for part, *_ in Formatter().parse(text)]
    long_enough = len(literal) == 1 or sum(map(len, literal)) >= _LISTED_CHARS
    parts = (re.escape(part) + ("" if name is None else ".*") for part, name, *_ in Formatter().parse(text))
    return "".join(parts) if long_enough else ""
