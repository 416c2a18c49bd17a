"""Which wrong poses of an object a photo could have told: the true object at rival poses.

An object may look like itself from several sides: it is symmetric, its paint repeats, or what tells
is hidden. A pose counts as wrong only where the TRUE object, drawn at it, differs from the true
object at its true pose by more than NOISE; and the photo determines a pose where that holds for all
rival poses. Compared are coverage, base colour, roughness, metallic and normals, which is all that
light can show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.conventions import similarity
from relit.evaluate.alignment import angles_between
from relit.geometry.se3 import exp_so3, nearest_rotation
from relit.reference.mitsuba_scene import Scene, render_channels
from relit.scene import Camera

NOISE = 0.03  # mean difference per covered pixel, of 1 for background in the place of the object
SIDE = 48  # pixels, the longer side of the compared pictures
SAMPLES = 8  # per pixel
RIVAL = 15.0  # degrees from the true pose from which on another one is a rival
FOLDS = 12  # turns about each principal axis that are tried as rivals
RANDOM = 24  # other rivals


@dataclass(frozen=True)
class SeenInstance:
    """One instance in its window of the photo. camera: of the window, in the world.
    world_from_object: (4, 4) similarity. known: (h, w) bool, pixels that show it or the background."""

    camera: Camera
    world_from_object: np.ndarray
    known: np.ndarray


class PoseJudge:
    """Draws the true object at rival poses of one instance. scene: the object alone, in its own
    frame. vertices, faces: of it."""

    def __init__(self, scene: Scene, vertices: np.ndarray, faces: np.ndarray):
        self.scene = scene
        self.middle = (vertices.min(0) + vertices.max(0)) / 2
        self.axes = principal_axes(vertices, faces)

    def difference(self, seen: SeenInstance, turn: np.ndarray) -> float:
        """By how much the object differs when it is turned by `turn` (3, 3), in its own frame, about
        its middle: mean over the covered known pixels, see `picture_difference`."""
        return picture_difference(
            self._drawn(seen, np.eye(3)), self._drawn(seen, turn), self._known(seen)
        )

    def determined(self, seen: SeenInstance, seed: int = 0) -> bool:
        """Whether all rival poses differ by more than NOISE."""
        true, known = self._drawn(seen, np.eye(3)), self._known(seen)
        return all(
            picture_difference(true, self._drawn(seen, turn), known) > NOISE
            for turn in self.rivals(seed)
        )

    def rivals(self, seed: int = 0) -> list[np.ndarray]:
        """Turns (3, 3) of RIVAL degrees and more: about the principal axes, and random ones."""
        angles = np.arange(1, FOLDS) * 2 * np.pi / FOLDS
        turns = [exp_so3(axis * angle) for axis in self.axes for angle in angles]
        rng = np.random.default_rng(seed)
        turns += [exp_so3(random_axis(rng) * rng.uniform(0.5, np.pi)) for _ in range(RANDOM)]
        return [t for t in turns if angles_between(t, np.eye(3)) >= RIVAL]

    def _camera(self, seen: SeenInstance) -> Camera:
        c = seen.camera
        scale = min(1.0, SIDE / max(c.width, c.height))
        return c.resized(max(4, round(c.width * scale)), max(4, round(c.height * scale)))

    def _known(self, seen: SeenInstance) -> np.ndarray:
        c = self._camera(seen)
        rows = (np.arange(c.height) * seen.known.shape[0]) // c.height
        columns = (np.arange(c.width) * seen.known.shape[1]) // c.width
        return seen.known[rows][:, columns]

    def _drawn(self, seen: SeenInstance, turn: np.ndarray) -> dict[str, np.ndarray]:
        """Channels of the object turned in its own frame: the camera moves instead."""
        camera = self._camera(seen)
        about = similarity(turn, self.middle - turn @ self.middle)
        object_from_camera = (
            np.linalg.inv(seen.world_from_object @ about) @ camera.world_from_camera
        )
        rotation = nearest_rotation(object_from_camera[:3, :3])
        pose = similarity(rotation, object_from_camera[:3, 3])
        drawn = render_channels(self.scene, camera.with_pose(pose), spp=SAMPLES)
        # normals in the camera's axes, as light sees them
        return {**drawn, "normal": drawn["normal"] @ rotation}


def picture_difference(
    a: dict[str, np.ndarray], b: dict[str, np.ndarray], known: np.ndarray
) -> float:
    """Mean over the known pixels that `a` covers of: 1 where only one of them covers a pixel, else
    the largest of the differences of base colour (as a share), roughness, metallic, and normals
    (half the distance)."""
    both = np.minimum(a["alpha"], b["alpha"])
    level = np.maximum(a["albedo"], b["albedo"]).mean(-1)
    colour = np.abs(a["albedo"] - b["albedo"]).mean(-1) / np.maximum(level, 0.05)
    differences = [colour, *(np.abs(a[k] - b[k]) for k in ("roughness", "metallic"))]
    differences.append(np.linalg.norm(a["normal"] - b["normal"], axis=-1) / 2)
    inside = both * np.minimum(np.max(differences, axis=0), 1)
    total = np.abs(a["alpha"] - b["alpha"]) + inside
    return float((total * known).sum() / max(float((a["alpha"] * known).sum()), 1.0))


def principal_axes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(3, 3) rows: principal axes of the surface by area."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    middle = (a + b + c) / 3
    offset = middle - (area @ middle) / area.sum()
    return np.linalg.eigh((offset * area[:, None]).T @ offset)[1].T


def random_axis(rng) -> np.ndarray:
    """A random unit vector (3,)."""
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)
