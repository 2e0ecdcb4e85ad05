"""Files of nails: shipped, of a person's folder, by path; and what is refused."""

import json
from pathlib import Path

import pytest

from sightline.case.picks import NailPicked
from sightline.errors import UnusableInputError
from sightline.from_images.interlocking import NailDrawn
from sightline.planning import Nail
from sightline.planning.nail.files import NAILS_FOLDER, known_nails, nail_of, shipped_nails

EDGE, CLICK = [[1, 2], [3, 4], [5, 6], [7, 8]], {"pa": [1, 2], "lateral": [3, 4]}
OWN = {
    "schema": "sightline-nail/1",
    "name": "Mine",
    "diameter_mm": 9.0,
    "hole_mm": 4.5,
    "bore_mm": 4,
    "material": "steel",
}


def _write(path: Path, **given: object) -> Path:
    path.write_text(json.dumps(OWN | given))
    return path


def test_shipped_nails_and_those_of_a_folder_are_known_by_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert nail_of("steel-10") == Nail(10.0, 5.0, 5.0, "steel", spacing_mm=28.0)
    assert nail_of("diameter:11 hole:5 bore:5 titanium") is None
    monkeypatch.setenv(NAILS_FOLDER, str(tmp_path))
    _write(tmp_path / "mine.json")
    _write(tmp_path / "steel-10.json")  # a shipped key stays
    assert nail_of("mine") == Nail(9.0, 4.5, 4.0, "steel") and nail_of("steel-10") == shipped_nails()["steel-10"].nail
    assert set(known_nails()) == {"mine", *shipped_nails()}


def test_a_file_of_picks_takes_a_key_a_file_or_sizes(tmp_path: Path) -> None:
    sizes = {"diameter_mm": 11.0, "hole_mm": 5.0, "bore_mm": 5, "material": "titanium", "spacing_mm": 28.0}

    def drawn(nail: object) -> NailDrawn:
        picked = {"nail": nail, "edges": {"pa": EDGE, "lateral": EDGE}, "holes": {"distal": CLICK}}
        return NailPicked.model_validate_json(json.dumps(picked)).drawn(())

    for given in ("titanium-11", str(_write(tmp_path / "n.json", **sizes)), sizes):
        assert drawn(given).nail == Nail(11.0, 5.0, 5.0, "titanium", spacing_mm=28.0)
    with pytest.raises(UnusableInputError, match="or one of steel-10"):
        drawn("titanium-99")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"hole_mm": 9.5}, "bad.json: a nail of 9.0 mm cannot have holes"),
        ({"material": "brass"}, "'titanium' or 'steel'"),
        ({"colour": "red"}, "colour"),
        ({"schema": "sightline-nail/2"}, "schema"),
        ({"diameter_mm": "9"}, "diameter_mm"),
    ],
)
def test_a_file_that_is_no_nail_is_refused(given: dict[str, object], words: str, tmp_path: Path) -> None:
    with pytest.raises(UnusableInputError, match=words):
        nail_of(str(_write(tmp_path / "bad.json", **given)))


def test_a_missing_file_or_folder_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UnusableInputError, match=r"cannot read none\.json"):
        nail_of(str(tmp_path / "none.json"))
    monkeypatch.setenv(NAILS_FOLDER, str(tmp_path / "none"))
    with pytest.raises(UnusableInputError, match="which is not a folder"):
        known_nails()
