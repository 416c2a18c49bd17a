"""The nouns of Relit. Frozen dataclasses; verbs live elsewhere. Frames and encodings: see
`conventions`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with optional lens distortion.

    width, height: pixels. fx, fy, cx, cy: pixels, pixel centres at +0.5 (so cx = width / 2 is the
    middle).
    world_from_camera: (4, 4) float64 rigid pose, OpenCV axes, in the frame of the user's cameras.
    distortion: OpenCV's (k1, k2, p1, p2[, k3[, k4, k5, k6]]); empty for a pinhole.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray
    distortion: tuple[float, ...] = ()

    @property
    def intrinsics(self) -> np.ndarray:
        """(3, 3) float64 matrix K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)

    @property
    def camera_from_world(self) -> np.ndarray:
        """(4, 4) float64, the inverse pose."""
        return np.linalg.inv(self.world_from_camera)

    @property
    def centre(self) -> np.ndarray:
        """(3,) camera centre in world units."""
        return np.asarray(self.world_from_camera)[:3, 3]

    def with_pose(self, world_from_camera: np.ndarray) -> Camera:
        return replace(self, world_from_camera=np.asarray(world_from_camera, dtype=np.float64))

    def within(self, side: int) -> Camera:
        """`resized` so that no side is longer than `side` pixels; the same size where none is."""
        factor = min(1.0, side / max(self.width, self.height))
        return self.resized(max(1, round(self.width * factor)), max(1, round(self.height * factor)))

    def resized(self, width: int, height: int) -> Camera:
        """The same camera for an image resampled to width x height pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
        )

    def project(self, points: np.ndarray) -> np.ndarray:
        """World points (..., 3) -> pixel coordinates and depth (..., 3), ignoring distortion."""
        m = self.camera_from_world
        q = np.asarray(points, dtype=np.float64) @ m[:3, :3].T + m[:3, 3]
        z = q[..., 2]
        safe = np.where(np.abs(z) < 1e-12, 1e-12, z)
        return np.stack(
            [self.fx * q[..., 0] / safe + self.cx, self.fy * q[..., 1] / safe + self.cy, z], axis=-1
        )


@dataclass(frozen=True)
class Pixels:
    """The decoded content of one photo.

    rgb: (H, W, 3) float32 linear Rec.709. mask: (H, W) float32 in [0, 1], 1 on the object, or None
    when not known.
    normal: (H, W, 3) float32 unit normals in OpenCV camera axes (a prior read from a file), or
    None.
    clipped: (H, W) bool, True where the file's code value was saturated; None for formats that hold
    no codes (EXR, HDR).
    white: what the largest code stands for in rgb, where there are codes: 1, unless the photo was
    scaled.
    labels: (H, W) int32, number of the object at each pixel of a photo of duplicates, 0 where there
    is none, or None.
    """

    rgb: np.ndarray
    mask: np.ndarray | None = None
    normal: np.ndarray | None = None
    clipped: np.ndarray | None = None
    labels: np.ndarray | None = None
    white: float = 1.0


@dataclass(frozen=True)
class Photo:
    """One photograph; decoded when `load()` is called, already undistorted and turned upright.

    name: path relative to the capture's root, as the user knows it.
    camera: the pinhole camera of the decoded (undistorted) image, or None before cameras are found.
    width, height: pixels of the decoded image. focal_hint: focal length in pixels from EXIF, or
    None.
    flash_energy: how much light the flash gave for this photo, in any unit that all photos share, 0
    where it did not fire; None where the format does not tell.
    """

    name: str
    load: Callable[[], Pixels]
    width: int
    height: int
    camera: Camera | None = None
    focal_hint: float | None = None
    flash_energy: float | None = None


@dataclass(frozen=True)
class Sphere:
    """The object sphere: the ball, in world units, that holds the object. centre: (3,) float64."""

    centre: np.ndarray
    radius: float

    @property
    def world_from_unit(self) -> np.ndarray:
        """(4, 4) similarity that carries the unit sphere at the origin onto this sphere."""
        out = np.diag([self.radius, self.radius, self.radius, 1.0]).astype(np.float64)
        out[:3, 3] = self.centre
        return out


@dataclass(frozen=True)
class Capture:
    """What `open_capture` found: photos, cameras or none, masks or none, the object sphere.

    root: the folder (or file) that was opened. format: 'photos', 'transforms', 'colmap', 'idr',
    'middlebury', 'llff', ...
    photos: training photos. held_out: photos the data set sets aside for testing (never used in a
    fit).
    sphere: object sphere in world units, or None until cameras are known.
    points: (N, 3) sparse points in world units, or None. up: (3,) unit up direction in world, or
    None when unknown.
    black_background: True where pixels outside the masks are known to be black (alpha composites,
    dark rooms).
    notes: what the reader did that the user did not ask for, one sentence each.
    kind: the kind of capture where the layout of the files tells it ('flash', 'duplicates',
    'collection'), else ''.
    objects: views of identical objects in all photos together, 0 where no labels tell.
    """

    root: Path
    format: str
    photos: tuple[Photo, ...]
    held_out: tuple[Photo, ...] = ()
    sphere: Sphere | None = None
    points: np.ndarray | None = None
    up: np.ndarray | None = None
    black_background: bool = False
    notes: tuple[str, ...] = field(default_factory=tuple)
    kind: str = ""
    objects: int = 0

    @property
    def folder(self) -> Path:
        """The folder that was opened, or that holds the file that was."""
        return self.root if self.root.is_dir() else self.root.parent

    @property
    def has_cameras(self) -> bool:
        return bool(self.photos) and all(p.camera is not None for p in self.photos)


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    vertices: (V, 3) float32. faces: (F, 3) int32, counter-clockwise from outside. normals: (V, 3)
    float32 unit, or None.
    uvs: (V, 2) float32 or None; v = 0 is the TOP row of the texture images (glTF's convention).
    """

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None


@dataclass(frozen=True)
class Material:
    """Metallic-roughness material, textures with row 0 at v = 0.

    base_color: (H, W, 3) float32 linear Rec.709 reflectance in [0, 1]. roughness: (H, W) float32,
    perceptual (alpha = r^2).
    metallic: (H, W) float32 in [0, 1]. ior: index of refraction of the dielectric part; F0 =
    ((ior-1)/(ior+1))^2.
    specular: (H, W) or (H, W, 3) float32 factor on the dielectric F0 (KHR_materials_specular), or
    None for 1.
    normal: (H, W, 3) float32 tangent-space normals, or None.
    diffuse: of a rough plastic (flash captures) its diffuse albedo, (H, W, 3) float32 linear in [0,
    1], else None. The plastic is this with alpha = roughness^2 and specular; base_color is then
    what looks like it under glTF (materials/plastic_as_gltf.py).
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    ior: float = 1.5
    specular: np.ndarray | None = None
    normal: np.ndarray | None = None
    diffuse: np.ndarray | None = None


@dataclass(frozen=True)
class Flash:
    """A point light that moves with the camera (PIR Eq. 4): at camera_centre + world_from_camera
    offset.

    offset: (3,) in OpenCV camera axes, world units. intensity: (3,) radiant intensity I, so that a
    white Lambertian surface facing the light at distance d shows radiance I / (pi d^2) in linear
    pixels.
    """

    offset: np.ndarray
    intensity: np.ndarray


@dataclass(frozen=True)
class Instance:
    """One of the identical objects in a photo of duplicates.

    label: its number in the label image. world_from_object: (4, 4) similarity from the asset frame,
    None where it was not registered.
    reason: why not; of one that was, what is uncertain about its pose. photo: number of the photo,
    from 0, that the label is of. chance_wrong: that its pose is wrong, by its agreement with a model of
    the other instances; None where it is unknown.
    """

    label: int
    world_from_object: np.ndarray | None
    reason: str = ""
    photo: int = 0
    chance_wrong: float | None = None

    @property
    def registered(self) -> bool:
        return self.world_from_object is not None


@dataclass(frozen=True)
class Ground:
    """The plane that objects stand on: a square of half width `radius` around `point` (3,), unit
    `normal` (3,) up, in world units.
    colour: (3,) linear base colour. roughness: perceptual."""

    point: np.ndarray
    normal: np.ndarray
    radius: float
    colour: np.ndarray
    roughness: float = 0.8


@dataclass(frozen=True)
class Asset:
    """A relightable object: what `RUN/asset` holds.

    mesh: in the asset frame (glTF: +Y up, the GLB's coordinates after its node transforms).
    world_from_asset: (4, 4) similarity from the asset frame to the frame of `cameras` and
    `environment`.
    environment: (H, W, 3) float32 lat-long radiance in the world frame (Mitsuba's axes), or None.
    cameras: (name, Camera) pairs in the world frame. meta: what goes to asset.json besides.
    flash: the light at the cameras of a flash capture, or None. instances, ground: of a photo of
    duplicates; world_from_asset is the pose of one of the instances then. lights: of a collection:
    one environment (H, W, 3) for each of `cameras`, with the photo's exposure in it.
    """

    mesh: Mesh
    material: Material
    world_from_asset: np.ndarray
    environment: np.ndarray | None = None
    cameras: tuple[tuple[str, Camera], ...] = ()
    meta: dict = field(default_factory=dict)
    flash: Flash | None = None
    instances: tuple[Instance, ...] = ()
    ground: Ground | None = None
    lights: tuple[np.ndarray, ...] = ()
