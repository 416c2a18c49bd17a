"""Objects that a seed makes: shapes and materials that no setting was chosen on.

The shape is the zero level of a signed distance field on a grid: superquadrics, capsules and rings
in a smooth union, displaced by noise. The material is noise in OBJECT SPACE, a field of its own for
each of base colour, roughness and metallic, so that gloss does not follow colour. GGX widths start
at LEAST_ALPHA.

`procedural:SEED[:KIND]` is such an object wherever an asset file is expected; see `object_file`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtr

from relit.errors import EXIT_USAGE, UserError, did_you_mean
from relit.files import cache_folder
from relit.geometry.atlas import cells
from relit.geometry.mesh import extract_mesh
from relit.scene import Material, Mesh
from relit.synthesize.primitives import Field, bowl, grid_points, lump, strut_frame

VERSION_OF_OBJECTS = 1  # of what a seed means; part of the file's name
PREFIX = "procedural"
OBJECT_KINDS = ("blob", "bowl", "thin", "metal", "gloss")
LEAST_ALPHA = (
    0.03  # GGX width of the smoothest region; below it a light map shows as a mirror image
)
LEAST_ROUGHNESS = float(np.sqrt(LEAST_ALPHA))
GRID = 112  # samples a side of the distance field; struts are at least 3 samples thick
FACES = 12_000
TEXELS = 1024  # a side: 9 texels along the edge of a face
NOISE_GRID = 64  # samples a side of a noise field over the object's cube
METALS = np.array(  # F0 in linear Rec.709: gold, copper, iron, aluminium, brass
    [
        [1.0, 0.71, 0.29],
        [0.93, 0.53, 0.38],
        [0.53, 0.51, 0.49],
        [0.91, 0.92, 0.92],
        [0.88, 0.7, 0.4],
    ]
)


@dataclass(frozen=True)
class ObjectSpec:
    """What names an object. kind: one of OBJECT_KINDS."""

    seed: int
    kind: str

    @property
    def name(self) -> str:
        return f"{PREFIX}-v{VERSION_OF_OBJECTS}-{self.seed}-{self.kind}"


def object_spec(text: str) -> ObjectSpec | None:
    """The object that 'procedural:SEED' or 'procedural:SEED:KIND' names, None for other text.

    Without a kind the seed chooses: consecutive seeds go through OBJECT_KINDS in order. Raises
    UserError for a malformed name.
    """
    head, *words = text.split(":")
    if head != PREFIX:
        return None
    if not 1 <= len(words) <= 2 or not words[0].isdecimal():
        raise UserError(
            f"no procedural object is named '{text}'",
            fix=f"write {PREFIX}:SEED or {PREFIX}:SEED:KIND, for example {PREFIX}:7:bowl",
            code=EXIT_USAGE,
        )
    seed = int(words[0])
    kind = words[1] if len(words) == 2 else OBJECT_KINDS[seed % len(OBJECT_KINDS)]
    if kind not in OBJECT_KINDS:
        raise UserError(
            f"unknown kind of object '{kind}'.{did_you_mean(kind, OBJECT_KINDS)}",
            fix=f"choose one of: {', '.join(OBJECT_KINDS)}",
            code=EXIT_USAGE,
        )
    return ObjectSpec(seed, kind)


def object_file(asset: str | Path) -> Path:
    """The file of an asset: `asset` itself, or for `procedural:SEED[:KIND]` (as the last part of
    the path) a GLB in the cache (`files.cache_folder`), made on the first call."""
    spec = object_spec(Path(asset).name)
    if spec is None:
        return Path(asset)
    file = cache_folder() / "objects" / f"{spec.name}.glb"
    if not file.exists():
        from relit.asset.gltf import write_glb

        file.parent.mkdir(parents=True, exist_ok=True)
        write_glb(file, *procedural_object(spec), name=spec.name)
    return file


def procedural_object(spec: ObjectSpec) -> tuple[Mesh, Material]:
    """Mesh with normals and uvs in [-1, 1]^3, y up, and its material. Deterministic by `spec`."""
    rng = np.random.default_rng([VERSION_OF_OBJECTS, spec.seed, OBJECT_KINDS.index(spec.kind)])
    shape = shape_of(spec.kind, rng)
    mesh = cells(extract_mesh(shape.distance, faces=FACES), TEXELS)
    points = texel_points(mesh, TEXELS)
    part = np.rint(sample(shape.part.astype(np.float32), points, order=0)).astype(int)
    return mesh, material_of(spec.kind, rng, points, part)


# ---------------------------------------------------------------- shape


def shape_of(kind: str, rng: np.random.Generator) -> Field:
    """The distance field of a kind of object, with the index of the part that each point is next
    to."""
    points = grid_points(GRID)
    bumps = noise_field(rng, broad=9.0, fine=0.0)
    if kind == "bowl":
        return bowl(points, rng, sample(bumps, points))
    if kind == "thin":
        return strut_frame(points, rng)
    return lump(points, rng, sample(bumps, points))


# ---------------------------------------------------------------- noise


def noise_field(rng: np.random.Generator, broad: float = 6.0, fine: float = 0.35) -> np.ndarray:
    """(n, n, n) [z, y, x] float32 over [-1, 1]^3: Gaussian noise of unit variance, two octaves.

    broad: standard deviation of the smoothing of the broad octave, in samples of NOISE_GRID. fine:
    amplitude of an octave 2.4 times finer.
    """
    shape = (NOISE_GRID,) * 3
    total = np.zeros(shape, np.float32)
    for sigma, amplitude in ((broad, 1.0), (broad / 2.4, fine)):
        white = rng.standard_normal(shape, dtype=np.float32)
        octave = gaussian_filter(white, sigma, mode="wrap")
        total += amplitude * octave / octave.std()
    return (total - total.mean()) / total.std()


def sample(field: np.ndarray, points: np.ndarray, order: int = 1) -> np.ndarray:
    """Interpolate a field [z, y, x] over [-1, 1]^3 at points (..., 3)."""
    at = (np.moveaxis(points[..., ::-1], -1, 0) + 1) / 2 * (field.shape[0] - 1)
    return map_coordinates(field, at.reshape(3, -1), order=order, mode="nearest").reshape(
        points.shape[:-1]
    )


def texel_points(mesh: Mesh, texels: int) -> np.ndarray:
    """(T, T, 3) float32: where each texel of an atlas of `geometry.atlas.cells` is on its face; in
    the gaps the face's plane is continued."""
    count = len(mesh.faces)
    side = int(np.ceil(np.sqrt((count + 1) // 2)))
    centre = (np.arange(texels) + 0.5) / texels
    u, v = np.meshgrid(centre, centre)
    column, row = np.floor(u * side).astype(int), np.floor(v * side).astype(int)
    upper = (u * side - column) + (v * side - row) > 1
    face = np.minimum(2 * (row * side + column) + upper, count - 1)
    uv = np.asarray(mesh.uvs, np.float64)[mesh.faces]  # (F, 3, 2)
    inverse = np.linalg.inv(np.stack([uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], -1))
    b = np.einsum("tsij,tsj->tsi", inverse[face], np.stack([u, v], -1) - uv[face, 0])
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces][face]  # (T, T, 3, 3)
    weights = np.stack([1 - b.sum(-1), b[..., 0], b[..., 1]], -1)
    return np.clip(np.einsum("tsk,tskj->tsj", weights, corners), -1, 1).astype(np.float32)


# ---------------------------------------------------------------- material


def material_of(
    kind: str, rng: np.random.Generator, points: np.ndarray, part: np.ndarray
) -> Material:
    """Material at points (T, T, 3) of parts (T, T), as `procedural_object` describes it."""
    base = paint(rng, points, part)
    low = LEAST_ROUGHNESS + 0.2 * rng.random() ** 2
    high = low + rng.uniform(0.35, 0.6)
    if kind == "metal":
        low, high = LEAST_ROUGHNESS, rng.uniform(0.3, 0.55)
    roughness = low + (high - low) * ndtr(1.6 * sample(noise_field(rng, 4.5), points))
    metallic = np.zeros(part.shape)
    region, metal = sample(noise_field(rng), points), METALS[rng.integers(len(METALS))]
    dark, has_metal, has_dark = rng.uniform(0.015, 0.05, 3), rng.random() < 0.6, rng.random() < 0.4
    glossy = rng.uniform(LEAST_ROUGHNESS, 0.24)
    if kind == "metal":
        metallic[:] = 1.0
        base = metal * (0.8 + 0.2 * base / base.max())  # F0 with a stain of the paint
    elif kind == "gloss":
        base, roughness = np.broadcast_to(dark, base.shape), np.full(part.shape, glossy)
    else:
        if has_dark:  # a region of dark lacquer: colour and gloss constant
            lacquer = smooth_ramp(-region - 0.9)
            base = base + lacquer[..., None] * (dark - base)
            roughness = roughness + lacquer * (glossy - roughness)
        if has_metal:
            metallic = smooth_ramp(region - 0.6)
            base = base + metallic[..., None] * (metal - base)
    return Material(
        np.clip(base, 0.01, 1).astype(np.float32),
        np.clip(roughness, LEAST_ROUGHNESS, 1).astype(np.float32),
        metallic.astype(np.float32),
    )


def paint(rng: np.random.Generator, points: np.ndarray, part: np.ndarray) -> np.ndarray:
    """(T, T, 3) linear base colour: per part two colours that blend over the object, and spots of a
    third."""
    blend = ndtr(1.5 * sample(noise_field(rng), points))[..., None]
    spots = smooth_ramp(sample(noise_field(rng, broad=2.6), points) - 0.8)[..., None]
    colours = rng.uniform(0.03, 0.85, (part.max() + 1, 3, 3)) ** 1.5
    a, b, c = (colours[part, k] for k in range(3))
    mixed = a + blend * (b - a)
    return mixed + spots * (c - mixed)


def smooth_ramp(x: np.ndarray, width: float = 0.1) -> np.ndarray:
    """0 below 0, 1 above `width`, smooth between."""
    t = np.clip(x / width, 0, 1)
    return t * t * (3 - 2 * t)
