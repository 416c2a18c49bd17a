"""Photos of one object from anywhere -> a relightable asset.

The recipe of the `collection` capture (SAMURAI, Boss et al. 2022). Stages:

    photos       decode; masks, given or by GrabCut; focal lengths by EXIF or a guess: photos.py
    links        groups of photos whose features match: cameras/links.py, links.py
    poses        coarse models and registration by rendering, in turns, from quadrants or from one
                 silhouette: registration/photos/poses.py
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

from relit.cameras.links import Group
from relit.conventions import similarity
from relit.errors import UserError
from relit.fit.collection.held_out import held_out_stage, look_again
from relit.fit.collection.links import links_stage, poses_from_links, with_focals
from relit.fit.collection.options import CollectionOptions, options_for
from relit.fit.collection.photos import LEAST_PHOTOS, CollectionPhoto, collection_crops, load_shots
from relit.fit.collection.shape import opened_stage, volume_stage
from relit.fit.collection.surface import (
    PhotoLightTerms,
    fit_collection_surface,
    light_family,
    light_options,
    posterior,
    start_collection_surface,
)
from relit.fit.passes.material_priors import ALBEDO_START, SurfaceOptions
from relit.fit.passes.pixels import PixelBank, place_cameras
from relit.fit.passes.volume import VolumeModel
from relit.fit.registration.photos.growth import find_poses
from relit.fit.registration.photos.poses import GREY, cross_validated_share, schedule_of
from relit.fit.shape.inpaint import painted_over
from relit.fit.shape.unseen import seen_faces
from relit.geometry.atlas import unwrap
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.hull import NoShape
from relit.geometry.mesh import extract_mesh, vertex_areas
from relit.geometry.sdf import dense_values, row_features
from relit.lighting.per_photo import COLUMNS, ROWS
from relit.materials.field import normal_map, pictures, start_material
from relit.recipe import FitContext, Recipe
from relit.rendering.appearance.fixed_light import features_at
from relit.rendering.transport import TraceableMesh
from relit.run import run_arrays
from relit.scene import Asset, Camera, Capture, Material, Mesh
from relit.settings import check_levels

# most of exchange_rate times steps: the lights are flatter than true ones, and highlights then ask
# for ever more of them
EXCHANGE = 14.0
# of SurfaceOptions: under many lights a photo's shade is not taken for paint, and smoothing blurs
# what is paint
SMOOTH_COLOUR = 0.05
BORNE_OUT = 0.25  # correlation of fine detail from which on a photo is taken to be in its place
# share of photos that fit as well elsewhere from which on the object is called alike from several
# sides: the stool of the suite `collection` has .02 with quadrants and .32 without
ALIKE = 0.15
LISTED = 10  # photos that are named at once
CHECKED = 12  # photos from which on the poses are checked by leaving out half of them


def reconstruct(capture: Capture, run, options: CollectionOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back."""
    fit = FitContext(run, options, seed)
    check_levels(options)
    light_family(options)  # a network that cannot be read is said before anything is searched
    shots, held, degrees = load_shots(capture, options, run)
    tints = np.array([s.tint for s in shots])
    groups = [] if "links" in options.without else links_stage(shots, run, seed)
    shots = with_focals(shots, groups)
    cameras, weights, held_fast = pose_stage(shots, groups, degrees, run, options, seed)
    bank, cameras, model = volume_stage(shots, cameras, weights, held_fast, tints, fit)
    cameras = second_look_stage(bank, shots, cameras, model, degrees, held_fast, fit)
    cameras = opened_stage(bank, shots, cameras, model, tints, fit)
    parts = mesh_stage(model, run, options)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])
    maps = surface_stage(bank, cameras, mesh, parts["albedo"], tints, fit)
    found = held_out_stage(held, shots, model, mesh, parts["albedo"], maps, cameras, degrees, fit)
    return assemble(
        shots + held,
        cameras + found[0],
        np.concatenate([maps["lights"], found[1]]),
        mesh,
        maps,
        [s.photo.name for s in held],
    )


# ---------------------------------------------------------------- stages


def pose_stage(
    shots: list[CollectionPhoto],
    groups: list[Group],
    degrees: float,
    run,
    options: CollectionOptions,
    seed: int,
):
    """The cameras, the photos' weights (P,), and which photos (P,) bool were put in place by
    matches."""
    if run.done("poses"):
        kept = run_arrays(run, "poses", "poses")
    else:
        with run.stage("poses", title="where the photos were taken from") as stage:
            kept = find_all(shots, groups, degrees, run, options, seed)
            stage.save("poses", **kept)
    judge_poses(
        kept["scores"], float(kept["agreement"]), shots, options, run
    )  # when resumed too: what was refused stays refused
    poses, scores, linked = kept["poses"], kept["scores"], kept["linked"]
    loss = 1 - scores
    weights = (
        np.ones(len(shots))
        if "posterior" in options.without
        else posterior(loss, [*loss, *loss][:1000] * (20 // len(loss) + 1))
    )
    return [s.camera.with_pose(p) for s, p in zip(shots, poses, strict=True)], weights, linked


def find_all(
    shots: list[CollectionPhoto],
    groups: list[Group],
    degrees: float,
    run,
    options: CollectionOptions,
    seed: int,
) -> dict[str, np.ndarray]:
    """poses (P, 4, 4), scores (P,), agreement (a share, NaN where it was not tried), linked (P,)
    bool."""
    crops, hints = collection_crops(shots), np.array([s.direction for s in shots])
    schedule, without = schedule_of(options.rounds), options.without
    try:
        begun = (
            None
            if "search" in without
            else poses_from_links(
                crops, groups, shots, hints, degrees, options.hypotheses, seed, run.say
            )
        )
        args = (
            crops,
            hints,
            degrees,
            schedule,
            options.hypotheses,
            options.starts,
            without,
            seed,
            run.say,
            options.polish,
            begun,
        )
        poses, scores = find_poses(
            *args, soft=options.lambda_c if options.assignment == "soft" else None
        )
    except NoShape as error:
        why = f"{error}: the masks belong to different objects, or are wrong"
        raise UserError(
            "no shape agrees with the photos", why, "look at the masks (relit inspect)", code=4
        ) from None
    linked = np.zeros(len(shots), bool) if begun is None else begun[2]
    share = np.nan
    if len(shots) >= CHECKED and "search" not in without and linked.mean() < 0.5:
        share = cross_validated_share(crops, poses, seed)
    return {"poses": poses, "scores": scores, "agreement": np.array(share), "linked": linked}


def judge_poses(
    scores: np.ndarray, share: float, shots: list[CollectionPhoto], options: CollectionOptions, run
) -> None:
    """Say how well the photos agree, and which do not. share: see `agreement`, NaN where it was not
    tried. Raises UserError (code 4) when the poses are wrong as a whole."""
    mean, least = float(np.mean(scores)), options.least_score
    run.say(f"mean score of the registration {mean:.3f} (1 is perfect; below {least} is a failure)")
    if np.isfinite(share):
        run.say(
            f"{share:.0%} of the photos find their place in a model of the others (below {options.least_agreement:.0%} is a failure)"
        )
    elif len(shots) < CHECKED:
        run.say(
            f"note: with fewer than {CHECKED} photos nothing tells whether the poses are right: look at the result"
        )
    worst = np.argsort(scores)
    low = [
        k
        for k in worst
        if scores[k]
        < np.median(scores) - 4 * max(float(np.median(np.abs(scores - np.median(scores)))), 0.004)
    ]
    if low:
        named = ", ".join(f"{shots[k].photo.name} ({scores[k]:.2f})" for k in low[:5])
        run.say(
            f"note: {len(low)} photos agree badly with the others (another object, a wrong mask or a wrong pose): {named}"
        )
    if mean < least or share < options.least_agreement:
        told = f"score {mean:.3f}, {least} is needed"
        if share < options.least_agreement:
            told = f"{share:.0%} find their place in a model of the others, {options.least_agreement:.0%} are needed"
        raise UserError(
            f"where the photos were taken from could not be found: they agree with no common shape ({told})",
            "too few photos, wrong masks, photos of different objects, quadrants of other photos, or an object alike from all sides",
            "look at the masks; answer `relit quadrants PHOTOS`; add photos between those that are far apart",
            code=4,
        )


def second_look_stage(
    bank: PixelBank, shots, cameras, model: VolumeModel, degrees, linked, fit: FitContext
):
    """The cameras, those of lost photos found anew (`linked` ones are not lost); `bank` gets them
    too."""
    run, options, seed = fit.run, fit.options, fit.seed
    if "search" in options.without:
        return cameras
    if run.done("second_look"):
        kept = run_arrays(run, "second_look", "cameras")
    else:
        with run.stage(
            "second_look", title="lost photos are looked for in the finished shape"
        ) as stage:
            seen = look_again(shots, cameras, model, degrees, linked, options, seed)
            named = ", ".join(shots[i].photo.name for i in seen.moved[:5])
            run.say(
                f"{len(seen.moved)} photos moved to where they fit better{': ' if seen.moved else ''}{named}"
            )
            say_borne_out(seen.detail, seen.as_well, [s.photo.name for s in shots], run)
            poses = np.array([c.world_from_camera for c in seen.cameras])
            kept = {
                "poses": poses,
                "focal": np.array([c.fx for c in seen.cameras]),
                "detail": seen.detail,
                "as_well": seen.as_well,
            }
            stage.save("cameras", **kept)
    cameras = [
        replace(c, fx=f, fy=f, world_from_camera=p)
        for c, f, p in zip(cameras, kept["focal"], kept["poses"], strict=True)
    ]
    place_cameras(bank, cameras)
    return cameras


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


def mesh_stage(model: VolumeModel, run, options: CollectionOptions) -> dict[str, np.ndarray]:
    """Mesh, atlas, and each vertex's colour without light: vertices, faces, normals, uvs,
    albedo."""
    if run.done("mesh"):
        return run_arrays(run, "mesh", "mesh")
    with run.stage("mesh", title="mesh and atlas") as stage:
        mesh, how = unwrap(
            extract_mesh(dense_values(model.grid), faces=options.faces), options.texture
        )
        if how != "xatlas":
            run.say(
                "note: the mesh was too difficult for charts; its atlas has one cell for every two faces"
            )
        f = features_at(model.grid, row_features(model.grid), mesh.vertices)
        albedo = np.maximum(f[:, :3] + GREY * np.maximum(f[:, 3:4], 0), 1e-3).astype(np.float32)
        parts = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            "uvs": mesh.uvs,
            "albedo": albedo,
        }
        stage.save("mesh", **parts)
    return parts


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
    bank: PixelBank, cameras, mesh: Mesh, albedo, tints, fit: FitContext
) -> dict[str, np.ndarray]:
    """Material and lights; what no photo shows is painted like what is next to it. Returns (and
    keeps) base_color, roughness, metallic, normal, lights (V, ROWS, COLUMNS, 3) in the unit
    frame."""
    run, options, seed = fit.run, fit.options, fit.seed
    if run.done("surface"):
        return run_arrays(run, "surface", "maps")
    o = surface_options(options)
    with run.stage("surface", steps=o.steps, title="material and lights (surface pass)") as stage:
        face, bary = rasterise_atlas(mesh, o.texture)
        known = face >= 0
        areas = vertex_areas(mesh)
        scale = ALBEDO_START / float((albedo * areas[:, None]).sum() / areas.sum() / 3)
        start = np.clip(
            fill_gutters(interpolate(albedo, mesh.faces, face, bary), known) * scale, 0.02, 0.95
        )
        material = start_material(o.texture, start, o.roughness_start, 0.05)
        model = start_collection_surface(material, tints, ALBEDO_START, light_family(options))
        traced = TraceableMesh(mesh, albedo * scale)
        terms = PhotoLightTerms(bank, traced, model, o, light_options(options))
        fit_collection_surface(terms, stage, seed)
        base, roughness, metallic = pictures(model.material)
        silent = int((model.weights < 0.3).sum())
        if silent:
            run.say(f"note: {silent} photos were all but silenced: the model does not explain them")
        paint = {"base_color": base, "roughness": roughness, "metallic": metallic}
        paint = painted_over(
            mesh,
            seen_faces(mesh, cameras),
            {n: fill_gutters(t, known) for n, t in paint.items()},
            face,
            bary,
        )
        maps = {
            **paint,
            "normal": normal_map(model.material),
            "lights": np.exp(model.lights()).reshape(-1, ROWS, COLUMNS, 3),
            "weights": model.weights,
        }
        stage.save("maps", **maps)
    return maps


# ---------------------------------------------------------------- the asset


def assemble(
    shots: list[CollectionPhoto],
    cameras: list[Camera],
    lights: np.ndarray,
    mesh: Mesh,
    maps,
    held: list[str],
) -> Asset:
    """The asset in the object's own frame. Cameras come at the photos' own size."""
    own = [c.resized(s.photo.width, s.photo.height) for c, s in zip(cameras, shots, strict=True)]
    environment = np.median(lights / lights.mean((1, 2, 3), keepdims=True), 0) * np.median(
        lights.mean((1, 2, 3))
    )
    material = Material(
        maps["base_color"], maps["roughness"], maps["metallic"], normal=maps["normal"]
    )
    pairs = tuple((s.photo.name, c) for s, c in zip(shots, own, strict=True))
    meta = {"held_out": held}
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
