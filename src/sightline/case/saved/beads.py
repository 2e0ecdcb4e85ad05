"""Detections and observations of their documents."""

from typing import Any

import numpy as np

from sightline.detection import Detections, Observations, RejectedCandidate
from sightline.errors import UnusableInputError


def detections(given: dict[str, Any]) -> Detections:
    """Return the detections of a document. Raises UnusableInputError where its lists differ in length."""
    _refuse_uneven(given, "uv_px", "radius_px", "covariance_px2", "kind", "contrast")
    return Detections(
        uv_px=np.array(given["uv_px"]).reshape(-1, 2),
        radius_px=np.array(given["radius_px"]),
        covariance_px2=np.array(given["covariance_px2"]).reshape(-1, 2, 2),
        kind=tuple(given["kind"]),
        contrast=np.array(given["contrast"]),
        image_shape=_shape(given["image_shape"]),
        rejected=_rejected(given["rejected"]),
    )


def observations(given: dict[str, Any]) -> Observations:
    """Return the observations of a document. Raises UnusableInputError where its lists differ in length."""
    covariance, radius, shape = (given[key] for key in ("covariance_px2", "radius_px", "image_shape"))
    known = [name for name in ("covariance_px2", "radius_px") if given[name] is not None]
    _refuse_uneven(given, "ids", "uv_px", *known)
    return Observations(
        view=given["view"],
        ids=tuple(given["ids"]),
        uv_px=np.array(given["uv_px"]).reshape(-1, 2),
        covariance_px2=None if covariance is None else np.array(covariance).reshape(-1, 2, 2),
        mirrored=given["mirrored"],
        image_shape=None if shape is None else _shape(shape),
        radius_px=None if radius is None else np.array(radius),
        rejected=None if given["rejected"] is None else _rejected(given["rejected"]),
    )


def _refuse_uneven(given: dict[str, Any], *names: str) -> None:
    if len({len(given[name]) for name in names}) > 1:
        raise UnusableInputError(f"{', '.join(names)} differ in length; save the result again")


def _shape(given: list[int]) -> tuple[int, int]:
    return given[0], given[1]


def _rejected(given: list[dict[str, Any]]) -> tuple[RejectedCandidate, ...]:
    return tuple(
        RejectedCandidate((one["uv_px"][0], one["uv_px"][1]), one["radius_px"], one["reason"]) for one in given
    )
