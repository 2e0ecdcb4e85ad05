"""Points and circles as people write them on the command line: 'pa:U,V lateral:U,V', with a third image oblique:U,V."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from sightline.calibration import CalibratedView
    from sightline.planning import Nail

Point = dict[str, tuple[float, ...]]
VIEWS, CHECK_VIEWS = ("pa", "lateral"), ("check-pa", "check-lateral")
OBLIQUE = "oblique"  # a third image
MIN_WIRE_POINTS = 5  # four on the centre line, and the tip


def parse_point(text: str, option: str) -> Point:
    """Return the numbers of 'pa:U,V lateral:U,V' or 'pa:U,V depth:MM' by name; of a third image also 'oblique:U,V'.

    The depth, mm, is counted along the line of sight from the PA view's XRII plate towards the X-ray source.
    Raises UnusableInputError.
    """
    from sightline.errors import UnusableInputError

    out = _numbers(text)
    third = dict.fromkeys({OBLIQUE} & out.keys(), 2)
    if _lengths(out) not in ({"pa": 2, "lateral": 2} | third, {"pa": 2, "depth": 1} | third):
        raise UnusableInputError(
            f"{option} {text!r} is not a point; write 'pa:U,V lateral:U,V' in pixels (for example "
            "'pa:512.3,401.8 lateral:498.0,377.2'), or 'pa:U,V depth:MM'; of a third image add 'oblique:U,V'"
        )
    return out


def parse_head(text: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the circle (u, v, radius) of each view in 'pa:U,V,R lateral:U,V,R'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    found = _numbers(text)
    if _lengths(found) != {"pa": 3, "lateral": 3}:
        raise UnusableInputError(
            f"--head {text!r} is not two circles; write centre and radius in pixels, 'pa:U,V,R lateral:U,V,R'"
        )
    return found["pa"], found["lateral"]


def parse_landmark(text: str) -> tuple[str, Point]:
    """Return the name of 'NAME pa:U,V lateral:U,V', "" without one, and its pixels by view.

    With a third image, 'oblique:U,V', one of the three may be left out. Raises UnusableInputError.
    """
    from sightline.errors import UnusableInputError

    name, rest = _named(text)
    point = _numbers(rest)
    if OBLIQUE in point and len(point) == 2 and _lengths(point) == dict.fromkeys({*VIEWS, OBLIQUE} & point.keys(), 2):
        return name, point
    point = parse_point(rest, "--landmark")
    if "depth" in point:
        raise UnusableInputError(
            f"--landmark {text!r} states a depth; a landmark is picked freely in both views: 'pa:U,V lateral:U,V'"
        )
    return name, point


def parse_wires(entries: Sequence[str], ends: Sequence[str]) -> dict[str, tuple[Point, Point]]:
    """Return entry and end of each wire of 'WIRE pa:U,V lateral:U,V', as `parse_point`; "" for one without a name.

    Raises UnusableInputError.
    """
    from sightline.errors import UnusableInputError

    split = [[(text, *_named(text)) for text in texts] for texts in (entries, ends)]
    named = [[(name, rest) if rest else ("", text) for text, name, rest in one] for one in split]
    first, second = ([name for name, _ in one] for one in named)
    if sorted(first) != sorted(second) or len(set(first)) < len(first) or ("" in first and len(first) > 1):
        raise UnusableInputError(
            f"--entry is given for {', '.join(map(repr, first))} and --end for {', '.join(map(repr, second))}; give "
            "one of each for every wire, of several wires with its name: --entry 'inferior pa:U,V lateral:U,V'"
        )
    starts, tips = (
        {name: parse_point(text, option) for name, text in one}
        for one, option in zip(named, ("--entry", "--end"), strict=True)
    )
    return {name: (point, tips[name]) for name, point in starts.items()}


def parse_aid(text: str) -> tuple[str, Point]:
    """Return the key of 'KEY pa:U,V,U,V,... lateral:U,V,U,V,...' and the numbers of its clicks by view; a view may be
    left out. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError

    key, rest = _named(text)
    clicked = _numbers(rest)
    if not key or not clicked or not clicked.keys() <= set(VIEWS) or any(len(uv) % 2 for uv in clicked.values()):
        raise UnusableInputError(
            f"--aid {text!r} is not a drawing; write its key and its clicks in pixels, 'shaft pa:U,V,U,V "
            "lateral:U,V,U,V'"
        )
    return key, clicked


NAIL_SIZES = ("diameter", "hole", "bore", "spacing")


def parse_hole(text: str) -> tuple[str, Point]:
    """Return the wire's key of 'WIRE pa:U,V lateral:U,V' and the click on its hole by view. Raises
    UnusableInputError."""
    from sightline.errors import UnusableInputError

    key, rest = _named(text)
    point = _numbers(rest)
    if not key or _lengths(point) != dict.fromkeys(VIEWS, 2):
        raise UnusableInputError(
            f"--hole {text!r} is not a hole; write its wire's key and a click in both images, 'distal pa:U,V "
            "lateral:U,V'"
        )
    return key, point


def parse_nail(strokes: str, sizes: str) -> "tuple[Nail, np.ndarray]":
    """Return a nail and its strokes (2, 2, 2, 2) of 'pa:U,V,U,V,... lateral:...', in each view two clicks on one edge,
    then two on the other. `sizes`: as of `--nail`. Raises UnusableInputError."""
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning.nail.files import nail_of

    clicked = _numbers(strokes)
    nail = nail_of(sizes) or _nail_of_sizes(sizes)
    if _lengths(clicked) != dict.fromkeys(VIEWS, 8):
        raise UnusableInputError(
            f"--nail-edges {strokes!r} does not give both edges of the nail; click two points on one edge, then two on "
            "the other, in both images: 'pa:U,V,U,V,U,V,U,V lateral:U,V,U,V,U,V,U,V'"
        )
    return nail, np.reshape([clicked[view] for view in VIEWS], (2, 2, 2, 2))


def _nail_of_sizes(sizes: str) -> "Nail":
    """Return the nail of 'diameter:11 hole:5 bore:5 spacing:28 titanium'. Raises UnusableInputError."""
    from sightline.errors import UnusableInputError
    from sightline.planning import Nail
    from sightline.planning.nail.files import known_nails

    material, rest = _named(sizes)
    mm = _numbers(rest)
    if not set(NAIL_SIZES[:3]) <= mm.keys() <= set(NAIL_SIZES) or any(n != 1 for n in _lengths(mm).values()):
        raise UnusableInputError(
            f"--nail {sizes!r} does not give the nail's sizes; write what its maker states, mm and the metal: "
            "'diameter:11 hole:5 bore:5 spacing:28 titanium' (the holes' spacing may be left out); or give a nail's "
            f"file, or one of {', '.join(known_nails())}"
        )
    return Nail(material=material, **{f"{name}_mm": value[0] for name, value in mm.items()})


@dataclass(frozen=True)
class FoundAgain:
    """A landmark found again in the check images, px.

    `checked`: a pixel for each view. `planned`: the same in the planning images; None where the text gives no planning
    pixels: then the plan must have a landmark of this `name`.
    """

    name: str
    checked: list[tuple[float, ...]]
    planned: list[tuple[float, ...]] | None


def parse_found_again(text: str) -> FoundAgain:
    """Return a landmark of 'NAME check-pa:U,V check-lateral:U,V', or with pa and lateral too. Raises
    UnusableInputError."""
    from sightline.errors import UnusableInputError

    name, rest = _named(text)
    point = _numbers(rest)
    known = dict.fromkeys(VIEWS, 2) if "pa" in point or "lateral" in point else {}
    if _lengths(point) != dict.fromkeys(CHECK_VIEWS, 2) | known or not (name or known):
        raise UnusableInputError(
            f"--landmark {text!r} is not a landmark; write 'NAME check-pa:U,V check-lateral:U,V' for a landmark of the "
            "plan, or 'pa:U,V lateral:U,V check-pa:U,V check-lateral:U,V' for another"
        )
    planned = [point[view] for view in VIEWS] if known else None
    return FoundAgain(name, [point[view] for view in CHECK_VIEWS], planned)


def parse_wire_points(text: str) -> "np.ndarray":
    """Return points on a wire in both images (2, M, 2), the tip last, of 'check-pa:U,V,U,V,... check-lateral:...'.

    Raises UnusableInputError.
    """
    import numpy as np

    from sightline.errors import UnusableInputError

    clicked = _numbers(text)
    counts = {len(clicked.get(view, ())) for view in CHECK_VIEWS}
    count = counts.pop()
    if counts or clicked.keys() != set(CHECK_VIEWS) or count % 2 or count < 2 * MIN_WIRE_POINTS:
        raise UnusableInputError(
            f"{text!r} is not a wire; write {MIN_WIRE_POINTS} points or more in each image, as many in both, the tip "
            "last: 'check-pa:U,V,U,V,... check-lateral:U,V,U,V,...'"
        )
    return np.array([clicked[view] for view in CHECK_VIEWS]).reshape(2, -1, 2)


def all_depths(points: Sequence[Point]) -> bool:
    """Return True if all points state a depth, False if none does. Raises UnusableInputError for a mixture."""
    from sightline.errors import UnusableInputError

    depths = {"depth" in point for point in points}
    if len(depths) == 2:
        raise UnusableInputError("one point states a depth and the other a lateral pixel; write both in one way")
    return depths == {True}


def pixels(point: Point, views: "Sequence[CalibratedView]", pick_sd_px: float) -> Any:
    """Return the pixels (V, 2) of a point, a row for each view; NaN in a third one that does not show it.

    A depth (`MatchingCurve.depth_mm`) is replaced by the lateral pixel of the image-matching curve at that depth.
    Raises UnusableInputError for a depth outside the curve, and what `matching_curve` raises.
    """
    import numpy as np

    from sightline.errors import UnusableInputError
    from sightline.planning import Pick, matching_curve

    first, third = np.array(point["pa"]), [point.get(view.name, (np.nan, np.nan)) for view in views[2:]]
    if "lateral" in point:
        return np.array([first, point["lateral"], *third])
    pick = Pick.free(first, pick_sd_px)
    curve = matching_curve(views[0], pick.uv_px, views[1], pick.covariance_px2)
    depth, (low, high) = point["depth"][0], (curve.depth_mm[0], curve.depth_mm[-1])
    if not low <= depth <= high:
        raise UnusableInputError(
            f"give a depth from {low:.0f} to {high:.0f} mm, counted from the PA view's XRII plate towards the X-ray "
            f"source; {depth:g} mm is outside the lateral view"
        )
    return np.array([first, [np.interp(depth, curve.depth_mm, curve.uv_px[:, k]) for k in range(2)], *third])


def _named(text: str) -> tuple[str, str]:
    """Return (name, rest): the words without a colon joined by "-", those with a colon joined by spaces."""
    words = text.split()
    return "-".join(word for word in words if ":" not in word), " ".join(word for word in words if ":" in word)


def _numbers(text: str) -> Point:
    """Return the finite numbers of 'name:1,2 other:3' by name; nothing where it is written otherwise."""
    out: Point = {}
    try:
        for part in text.split():
            name, numbers = part.split(":")
            if name in out:
                return {}
            out[name] = tuple(float(number) for number in numbers.split(","))
    except ValueError:
        return {}
    return out if all(isfinite(number) for numbers in out.values() for number in numbers) else {}


def _lengths(point: Point) -> dict[str, int]:
    return {name: len(numbers) for name, numbers in point.items()}
