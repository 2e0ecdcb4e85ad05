"""ITK's registration of a CT to two projections, on the same images and from the same starts, with exact views.

Optional: `pip install itk-twoprojectionregistration` (2.0.1, Apache-2). Its sources rotate about an isocentre: here the
bone's centre at the start, in a plane that holds both sources. An image may lie anywhere before its source, so that
views of any matrix will do.
"""

import time
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.bone_trials import Record, movable, registered
from benchmarks.scenes.bones import BoneScene
from sightline.common.geometry.lines import unit
from sightline.from_images.registration import BoneStart, ScannedBone
from sightline.from_images.registration.align import FINE
from sightline.from_images.registration.observed import BoneShot, Observed
from sightline.imaging.volumes.volume import Volume

INSTALLED = find_spec("itk") is not None and find_spec("itk.TwoProjectionRegistrationPython") is not None
# What follows was chosen on scenes 9200 and 9201, among blurs of 4, 8, 12 and 24 pixels.
BACKGROUND_PX = 6.0  # s.d. of the blur whose result is subtracted from an image: soft tissue
STEPS = 4.0, 1.0  # of Powell's optimiser, mm and degrees, one after another
FAR_MM = 1000.0  # from the source to the plane that carries the pixels


def peer_trial(k: int) -> dict[str, Record]:
    """Return errors and processor times, s, of ours, and of ITK with the bone alone and with the whole scan."""
    scene, bone, start = movable(k)
    images, views = list(scene.images.values()), scene.exact_views()
    before = time.process_time()
    found = {"ours": registered(scene, bone, images, views, start)}
    found["ours"]["time_s"] = time.process_time() - before
    scan = scene.ct
    whole = Volume((scan.hu + 1000.0).astype(np.float32), scan.origin_mm, scan.voxel_mm, scan.axes)
    for name, volume in (("bone alone", bone.volume), ("whole scan", whole)):
        before = time.process_time()
        pose = TwoProjections(scene, bone, start).pose(volume)
        off = pose.apply(scene.targets_mm) - scene.pose.apply(scene.targets_mm)
        found[name] = {"error_mm": float(np.linalg.norm(off, axis=1).mean()), "time_s": time.process_time() - before}
    return found


class TwoProjections:
    """A scene in ITK's geometry: axes of the gantry, which rotates about the third, from the bone's centre (3,)."""

    def __init__(self, scene: BoneScene, bone: ScannedBone, start: BoneStart) -> None:
        self.bone, self.start, self.centre = bone, start, start.pose.apply(bone.centre_mm)
        corners = start.pose.apply(bone.corners_mm)
        shots = zip(scene.images.values(), scene.exact_views(), strict=True)
        self.seen = [BoneShot(image, view).pooled(FINE.size).around(corners) for image, view in shots]
        self.focal = np.array([seen.view.focal_point_mm - self.centre for seen in self.seen])
        normal = unit(np.cross(*self.focal))
        self.gantry = np.array([unit(self.focal[0]), np.cross(normal, unit(self.focal[0])), normal])

    def pose(self, volume: Volume) -> RigidTransform:
        """Return the pose that ITK finds."""
        import itk

        kind = itk.Image[itk.F, 3]
        transform, axes = self._transform(volume), volume.axes
        metric = itk.NormalizedCorrelationTwoImageToOneImageMetric[kind, kind].New()
        metric.ComputeGradientOff()
        metric.SetSubtractMean(True)
        method = itk.TwoProjectionImageRegistrationMethod[kind, kind].New(Metric=metric, Transform=transform)
        scan = itk.image_from_array(np.ascontiguousarray(volume.values.transpose(2, 1, 0), dtype=np.float32))
        scan.SetSpacing(volume.voxel_mm.tolist())
        method.SetMovingImage(scan)
        views = [self._view(number, transform, method, metric) for number in (0, 1)]
        optimiser = itk.PowellOptimizer.New(Maximize=False, MaximumIteration=20, MaximumLineIteration=10)
        optimiser.SetStepTolerance(0.01)
        optimiser.SetValueTolerance(1e-6)
        optimiser.SetScales([180 / np.pi] * 3 + [1.0] * 3)
        method.SetOptimizer(optimiser)
        for step in STEPS:
            optimiser.SetStepLength(step)
            method.SetInitialTransformParameters(transform.GetParameters())
            method.Update()
            transform.SetParameters(method.GetLastTransformParameters())
        del views  # ITK keeps no images alive
        *angles, x, y, z = (transform.GetParameters().GetElement(i) for i in range(6))
        turn = Rotation.from_matrix(self.gantry.T) * Rotation.from_euler("xyz", angles) * Rotation.from_matrix(axes)
        at = self.centre + self.gantry.T @ [x, y, z]
        return RigidTransform.from_components(at - turn.apply(self.bone.centre_mm), turn)

    def _transform(self, volume: Volume) -> Any:
        """Return the start, from the volume, which begins at 0 for ITK, to the gantry."""
        import itk

        gantry, axes = Rotation.from_matrix(self.gantry), Rotation.from_matrix(volume.axes.T)
        transform = itk.Euler3DTransform[itk.D].New()
        transform.SetComputeZYX(True)
        centre = volume.axes @ (self.bone.centre_mm - volume.origin_mm) + volume.voxel_mm / 2
        transform.SetCenter(centre.tolist())
        transform.SetRotation(*(gantry * self.start.pose.rotation * axes).as_euler("xyz").tolist())
        return transform

    def _view(self, number: int, transform: Any, method: Any, metric: Any) -> Any:
        """Set a view's ray caster, image and mask, and return them."""
        import itk

        source = self.gantry @ self.focal[number]
        angle = float(np.arctan2(source[0], -source[1]))
        caster = itk.SiddonJacobsRayCastInterpolateImageFunction[itk.Image[itk.F, 3], itk.D].New()
        caster.SetProjectionAngle(angle)
        caster.SetFocalPointToIsocenterDistance(float(np.linalg.norm(source)))
        caster.SetTransform(transform)
        caster.Initialize()
        camera = Rotation.from_euler("x", -np.pi / 2) * Rotation.from_euler("z", -angle)
        image, mask = projected(self.seen[number], camera.as_matrix() @ self.gantry)
        for what, value in (
            ("FixedImage", image),
            ("FixedImageRegion", image.GetBufferedRegion()),
            ("Interpolator", caster),
        ):
            getattr(method, f"Set{what}{number + 1}")(value)
        getattr(metric, f"SetFixedImageMask{number + 1}")(mask)
        return caster, image, mask


def projected(seen: Observed, axes: np.ndarray) -> tuple[Any, Any]:
    """Return an image less its background, and its mask, in space, from the source on along `axes` (3, 3)."""
    import itk

    usable, view = seen.known.astype(float), seen.view
    sums = [gaussian_filter(values, BACKGROUND_PX) for values in (seen.attenuation * usable, usable)]
    bony = np.where(seen.known, seen.attenuation - sums[0] / np.maximum(sums[1], 1e-3), 0.0)
    back = np.linalg.inv(view.matrix[:, :3])  # from pixels to directions
    first = back @ np.append(seen.corner_px + (seen.factor - 1) / 2, 1.0)
    length = FAR_MM / np.linalg.norm(first) * np.sign(first @ -view.focal_point_mm)
    steps = length * seen.factor * axes @ back[:, :2]
    size = np.linalg.norm(steps, axis=0)
    right, down = (steps / size).T
    image, mask = (
        itk.image_from_array(values[None]) for values in (bony.astype(np.float32), seen.known.astype(np.uint8))
    )
    for each in (image, mask):
        each.SetOrigin((length * axes @ first).tolist())
        each.SetSpacing([*size.tolist(), 1.0])
        each.SetDirection(itk.matrix_from_array(np.column_stack([right, down, np.cross(right, down)])))
    inside = itk.ImageMaskSpatialObject[3].New(Image=mask)
    inside.Update()
    return image, inside
