"""Photos of one object from anywhere -> a relightable asset.

The recipe of the `collection` capture (SAMURAI, Boss et al. 2022). Stages:

    photos       decode; masks, given or by GrabCut; focal lengths by EXIF or a guess: photos.py
    links        groups of photos whose features match: cameras/links.py, links.py
    poses        coarse models and registration by rendering, in turns, from quadrants or from one
                 silhouette: photo_poses.py, registration/photos/poses.py
    volume       signed distance field, one small light per photo, cameras and focal lengths free:
                 shape.py
    second_look  photos in wrong places are registered again against the finished shape, and
                 verified by fine detail: held_out.py, registration/fine_detail.py
    hollows      test for space under flat faces that no silhouette shows: fit/shape/lids.py
    opened       with such a space, the finer levels of the volume pass again
    mesh         zero level set, decimated; texture atlas
    surface      metallic-roughness textures, one environment per photo: surface.py
    held_out     camera and light of photos that were set aside, with the model frozen: held_out.py

The result is in the object's own frame, in which quadrants are given: +x right, +y up, +z to the
front; the object sphere has radius 1.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from relit.conventions import similarity
from relit.fit.collection.held_out import (
    HeldOutPhotos,
    SecondLook,
    held_out_stage,
    look_again,
)
from relit.fit.collection.links import LinkedGroups, links_stage
from relit.fit.collection.options import CollectionOptions, options_for
from relit.fit.collection.photo_poses import BORNE_OUT, PhotoPoses, pose_stage
from relit.fit.collection.photos import LEAST_PHOTOS, PhotoSet, load_shots
from relit.fit.collection.shape import FittedShape, opened_stage, volume_stage
from relit.fit.collection.surface import (
    AlbedoMesh,
    PhotoLightTerms,
    PhotoLitMaterial,
    fit_collection_surface,
    light_family,
    light_options,
    start_collection_surface,
)
from relit.fit.collection.verdict import check_borne_out
from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
from relit.fit.passes.volume import VolumeModel
from relit.fit.registration.photos.poses import GREY
from relit.fit.shape.mesh_stage import texels_of, with_atlas
from relit.fit.shape.unseen import seen_faces
from relit.geometry.mesh import extract_mesh
from relit.geometry.sdf import dense_values, row_features
from relit.lighting.per_photo import COLUMNS, ROWS
from relit.materials.field import start_material
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import features_at
from relit.rendering.transport import TraceableMesh
from relit.scene import Asset, Capture, Material, Mesh
from relit.settings import check_levels

# most of exchange_rate times steps: the lights are flatter than true ones, and highlights then ask
# for ever more of them
EXCHANGE = 14.0
# of SurfaceOptions: under many lights a photo's shade is not taken for paint, and smoothing blurs
# what is paint
SMOOTH_COLOUR = 0.05
# share of photos that fit as well elsewhere from which on the object is called alike from several
# sides: the stool of the suite `collection` has .02 with quadrants and .32 without
ALIKE = 0.15
LISTED = 10  # photos that are named at once


def reconstruct(capture: Capture, run, options: CollectionOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back."""
    fit = FitContext(run, options, seed)
    check_levels(options)
    light_family(options)  # a network that cannot be read is said before anything is searched
    photos = load_shots(capture, options, run)
    if "links" in options.without:
        linked = LinkedGroups(())
    else:
        linked = links_stage(photos.shots, run, seed)
    poses = pose_stage(photos, linked.groups, fit)
    photos = photos.with_cameras(poses.cameras(photos.shots))
    shape = volume_stage(photos, poses, fit)
    second_look_stage(shape, photos, poses, fit)
    opened_stage(shape, photos, fit)
    colours = mesh_stage(shape.model, fit)
    maps = surface_stage(shape, photos, colours, fit)
    held = held_out_stage(shape, photos, colours, maps, fit)
    return assemble(photos, shape, colours.mesh, maps, held)


# ---------------------------------------------------------------- stages


def second_look_stage(
    shape: FittedShape, photos: PhotoSet, poses: PhotoPoses, fit: FitContext
) -> None:
    """Search lost photos again in the finished shape (those placed by matches are not lost); `shape`
    takes their cameras. Refuses poses that all evidence contradicts."""
    run, options, names = fit.run, fit.options, photos.names
    if "search" in options.without:
        return

    def computed(stage) -> SecondLook:
        seen = look_again(shape, photos, poses.linked, fit)
        named = ", ".join(names[i] for i in seen.moved[:5])
        run.say(
            f"{len(seen.moved)} photos moved to where they fit better{': ' if len(seen.moved) else ''}{named}"
        )
        say_borne_out(seen.detail, seen.as_well, names, run)
        return seen

    title = "lost photos are looked for in the finished shape"
    seen = run.cached("second_look", SecondLook, computed, title=title)
    shape.place(seen.placed(shape.cameras))
    borne_out = float((seen.detail >= BORNE_OUT).mean())
    check_borne_out(photos, shape.cameras, poses.evidence.agreement, borne_out, run)


def say_borne_out(detail: np.ndarray, as_well: np.ndarray, names: list[str], run) -> None:
    """Say how many photos show what the others show at the same places, and whose places are told
    by nothing. detail, as_well: (P,), see `SecondLook`."""
    low = np.flatnonzero(detail < BORNE_OUT)
    run.say(
        f"fine detail: {len(detail) - len(low)} of {len(detail)} photos show what the others show at the same places "
        f"(correlation of {BORNE_OUT} and more; median {np.median(detail):.2f}; -1 where too little is shared)"
    )
    if len(low) > 0.5 * len(detail):
        run.say(
            "note: most photos are not borne out by the others in fine detail: they are in wrong places, too far apart, of different "
            "objects, or the object is plain or mirrors its surroundings: look at the result; photos between these and masks help"
        )
        return  # what fits as well elsewhere then says nothing of the object
    if len(low):
        listed = ", ".join(names[i] for i in low[np.argsort(detail[low])][:LISTED]) + (
            " ..." if len(low) > LISTED else ""
        )
        run.say(
            f"note: not borne out by the others in fine detail (another object, a wrong place, or a plain side): {listed}"
        )
    placed = (
        detail >= BORNE_OUT
    )  # of the others no place is known, so that other places say nothing of the object
    unsure = np.flatnonzero(as_well * placed)
    if len(unsure):
        turn = f"{len(unsure)} of {placed.sum()} photos fit about as well elsewhere, turned by {np.median(as_well[unsure]):.0f} degrees"
        if len(unsure) > ALIKE * placed.sum():
            run.say(
                f"note: {turn}: the object is alike from several sides, and the poses hold up to such turns only: "
                "colours of one side may stand on another; answer `relit quadrants PHOTOS`"
            )
        else:
            run.say(f"note: {turn}: {', '.join(names[i] for i in unsure[:LISTED])}")


def mesh_stage(model: VolumeModel, fit: FitContext) -> AlbedoMesh:
    """Mesh, atlas, and each vertex's colour without light."""
    run, options = fit.run, fit.options

    def computed(stage) -> AlbedoMesh:
        mesh = extract_mesh(dense_values(model.grid), faces=options.faces)
        mesh = with_atlas(mesh, options.texture, run.say)
        f = features_at(model.grid, row_features(model.grid), mesh.vertices)
        albedo = np.maximum(f[:, :3] + GREY * np.maximum(f[:, 3:4], 0), 1e-3).astype(np.float32)
        return AlbedoMesh(mesh, albedo)

    return run.cached("mesh", AlbedoMesh, computed, title="mesh and atlas")


def surface_options(options: CollectionOptions) -> SurfaceOptions:
    """Of the surface pass: longer passes do not exchange more scale between lights and base
    colour."""
    own = SurfaceOptions(options.surface_steps, options.points, options.directions, options.texture)
    return replace(
        own,
        smooth_colour=SMOOTH_COLOUR,
        exchange_rate=min(own.exchange_rate, EXCHANGE / max(own.steps, 1)),
    )


def surface_stage(
    shape: FittedShape, photos: PhotoSet, colours: AlbedoMesh, fit: FitContext
) -> PhotoLitMaterial:
    """Material and lights; texels that no photo shows continue the seen ones."""
    run, options, o = fit.run, fit.options, surface_options(fit.options)
    mesh = colours.mesh

    def computed(stage) -> PhotoLitMaterial:
        texels, scale = texels_of(mesh, o.texture), colours.scale
        start = np.clip(texels.spread(colours.albedo) * scale, 0.02, 0.95)
        material = start_material(o.texture, start, o.roughness_start, 0.05)
        model = start_collection_surface(
            material, photos.tints, ALBEDO_START, light_family(options)
        )
        traced = TraceableMesh(mesh, colours.albedo * scale)
        terms = PhotoLightTerms(shape.bank, traced, model, o, light_options(options))
        fit_collection_surface(terms, stage, fit.seed)
        silent = int((model.weights < 0.3).sum())
        if silent:
            run.say(f"note: {silent} photos were all but silenced: the model does not explain them")
        return PhotoLitMaterial(
            **texels.material_maps(model.material, seen_faces(mesh, shape.cameras)),
            lights=np.exp(model.lights()).reshape(-1, ROWS, COLUMNS, 3),
            weights=model.weights,
        )

    title = "material and lights (surface pass)"
    return run.cached("surface", PhotoLitMaterial, computed, steps=o.steps, title=title)


# ---------------------------------------------------------------- the asset


def assemble(
    photos: PhotoSet,
    shape: FittedShape,
    mesh: Mesh,
    maps: PhotoLitMaterial,
    held: HeldOutPhotos,
) -> Asset:
    """The asset in the object's own frame. Cameras come at the photos' own size."""
    shots = photos.shots + photos.held
    cameras = shape.cameras + held.cameras(photos.held)
    lights = np.concatenate([maps.lights, held.lights])
    environment = np.median(lights / lights.mean((1, 2, 3), keepdims=True), 0) * np.median(
        lights.mean((1, 2, 3))
    )
    material = Material(maps.base_color, maps.roughness, maps.metallic, normal=maps.normal)
    pairs = tuple(
        (s.photo.name, c.resized(s.photo.width, s.photo.height))
        for s, c in zip(shots, cameras, strict=True)
    )
    meta = {"held_out": [s.photo.name for s in photos.held]}
    return Asset(
        mesh,
        material,
        similarity(np.eye(3), np.zeros(3)),
        environment.astype(np.float32),
        pairs,
        meta,
        lights=tuple(lights),
    )


RECIPE = Recipe(
    name="collection",
    light="one light per photo (collection)",
    options=options_for,
    run=reconstruct,
    stages=(
        *("links", "poses", "volume", "second_look", "hollows", "opened", "mesh", "surface"),
        "held_out",
    ),
    cost={"draft": (150.0, 1.2e9), "standard": (360.0, 1.8e9), "high": (2500.0, 3.0e9)},
    finds_cameras=True,
    min_photos=LEAST_PHOTOS,
    ablations={
        "quadrants": "hints of the directions that photos were taken from",
        "search": "registration by rendering",
        "multiplex": "several poses of each photo in the coarse fits (SAMURAI Sec. 3.3)",
        "posterior": "weights of photos by how well they are explained (SAMURAI Eq. 9)",
        "coarse_to_fine": "the order of the coarse fits, small photos first",
        "light_prior": "the prior of natural illumination (SAMURAI, Neural-PIL)",
        "links": "groups of photos that feature matches connect",
    },
)
