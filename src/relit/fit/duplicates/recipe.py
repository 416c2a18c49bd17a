"""Photos of several identical objects under an unknown light -> object, poses, material and light.

The recipe of the `duplicates` capture (SfD, Cheng et al. 2023). Stages:

    poses    a virtual camera for each instance; matching, and search by rendering: poses.py,
             registration/instances/search.py
    photos   of several photos of one pile, the motions between them: photo_motions.py
    joint    one signed distance field in the object's frame, moved together with the poses;
             outliers are left out, unregistered instances recovered: pose_passes.py,
             recover_unregistered.py
    vessel   ends of a body of revolution: cut off square, and hollow where light shows it:
             vessels.py, vessel_trial.py
    volume   the same pass again from those poses: shape.py
    mesh     zero level set, decimated; mesh and poses aligned by outlines and textures; texture
             atlas; the ground: fit/shape/alignment.py
    surface  one material for all instances and one environment, light traced past all instances
             and the ground: fit/passes/surface.py
    turns    guessed azimuths of a body of revolution, compared with the photo:
             azimuth_refinement.py
    asset    object, instances, ground and light in the frame of the user's camera

SfD Sec. 3: ξ_obj_i = ξ_ref ∘ (ξ_cam_i)^-1. With one photo ξ_ref is the photo's camera, so instance
i has the pose world_from_camera (object_from_camera_i)^-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from relit.capture.networks import Network, predicted_normals
from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.fit.duplicates.azimuth_refinement import SCENES, turned_as_shown
from relit.fit.duplicates.ground_paint import ground_as_shown
from relit.fit.duplicates.indirect_light import ASLANT, HiddenLight, hidden_from
from relit.fit.duplicates.lit_pile import LitPile, lit_pile, pile_surface_options
from relit.fit.duplicates.options import WITHOUT, DuplicatesOptions, options_for
from relit.fit.duplicates.placed_pile import PlacedPile
from relit.fit.duplicates.poses import PilePoses, Shot, all_views, instance_name, poses_stage
from relit.fit.duplicates.scene import ground_colour, ground_reflectance, light_below
from relit.fit.duplicates.shape import FoundViews, shape_stages
from relit.fit.duplicates.vessels import body_axis
from relit.fit.passes.first_material import PAINT, first_material
from relit.fit.passes.material_priors import ALBEDO_START
from relit.fit.passes.surface import (
    EnvironmentTerms,
    SurfaceModel,
    TexelStart,
    fit_surface,
    start_surface,
)
from relit.fit.registration.instances.views import InstanceView, ViewId
from relit.fit.shape.mesh_stage import TexelMap, texels_of
from relit.fit.shape.unseen import seen_faces
from relit.geometry.se3 import nearest_rotation, rotation_angle, rotation_from
from relit.lighting.gaussian_light import GaussianLight
from relit.recipe import FitContext, ObjectCost, Recipe
from relit.scene import Asset, Camera, Capture, Ground, Instance, Material, Mesh, Pixels
from relit.settings import check_levels


def reconstruct(capture: Capture, run, options: DuplicatesOptions, seed: int = 0) -> Asset:
    """Run all stages of the recipe in the run folder; stages that are done are read back."""
    fit = FitContext(run, options, seed)
    check_levels(options)
    photos = labelled_photos(capture)
    # each photo's own frame: OpenCV axes, unit lengths of the object
    shots = [(with_normals(p.load(), options), p.camera.with_pose(np.eye(4))) for p in photos]
    if len(photos) > 1 and all(
        len(np.unique(pixels.labels[pixels.labels > 0])) == 1 for pixels, _ in shots
    ):
        run.say(
            f"note: one object in {len(photos)} photos: it is placed by search; from all around --capture multiview is more exact"
        )
    if (
        "normals" in options.without
        and not options.normal_network
        and all(pixels.normal is None for pixels, _ in shots)
    ):
        run.say("note: without=normals changes nothing: no photo has normal priors")
    poses = poses_stage(shots, fit)
    shown = {v.id: v for v in all_views(shots, options.side, options)}
    pile = shape_stages(shots, found_views(poses, shown), fit)
    camera = photos[0].camera
    maps = surface_stage(shots, camera, pile, fit)
    asset = assemble(photos, pile, maps, poses)
    if pile.guessed:
        turned = turns_stage(asset, pile, [*shown.values()], camera, fit)
        asset = assemble(photos, turned, maps, poses)
    return ground_as_shown(asset, shots[0][0], seed)


def found_views(found: PilePoses, shown: dict[ViewId, InstanceView]) -> FoundViews:
    """The views by what the search has found of them."""
    views = [(shown[i], k) for k, i in enumerate(found.ids) if i in shown]
    placed = [k for _, k in views if found.registered[k]]
    return FoundViews(
        [v for v, k in views if found.registered[k]],
        found.poses[placed],
        [v for v, k in views if not found.registered[k]],
        {i: found.poses[k] for k, i in enumerate(found.ids) if found.axis_only[k]},
    )


def labelled_photos(capture: Capture) -> tuple:
    """The capture's photos. Raises UserError where they have no labels."""
    if capture.kind != "duplicates":
        name = capture.photos[0].name.rsplit(".", 1)[0]
        raise UserError(
            "the photos have no labels",
            "which pixel belongs to which object is not known",
            f"put {name}_labels.png beside it: one grey level or colour for each object, black elsewhere",
        )
    return capture.photos


def with_normals(pixels: Pixels, options: DuplicatesOptions) -> Pixels:
    """The photo with normal priors from the network of the options, where there is one and no file
    holds any."""
    if not options.normal_network or pixels.normal is not None or "normals" in options.without:
        return pixels
    return replace(
        pixels, normal=predicted_normals(Network(options.normal_network), pixels.rgb, pixels.labels)
    )


# ---------------------------------------------------------------- material and light


@dataclass(frozen=True)
class PileMaterial:
    """Textures (S, S[, 3]) of a metallic-roughness material, linear: base_color, roughness,
    metallic, normal (tangent space). environment: (H, 2 H, 3) radiance, lat-long in the scene frame.
    ground_colour: (3,) base colour of the ground."""

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray
    environment: np.ndarray
    ground_colour: np.ndarray


def surface_stage(
    shots: list[Shot], camera: Camera, pile: PlacedPile, fit: FitContext
) -> PileMaterial:
    """Material and light, in the scene frame: the world's axes, unit lengths of the object, the
    origin in the middle of the pile. Texels that no instance shows continue the shown ones. camera:
    of the first photo."""
    o, options = pile_surface_options(fit.options), fit.options

    def computed(stage) -> PileMaterial:
        alone = "visibility" in options.without
        lit = lit_pile(shots, camera, pile, options.max_pixels, alone=alone)
        texels = texels_of(pile.mesh, o.texture)
        model = pile_material_start(lit, pile, texels, stage, fit)
        gathered = None
        if "hidden" not in options.without and not lit.alone:
            hidden = hidden_from(lit.traced, lit.cameras)
            gathered = HiddenLight(lit.traced, hidden, lit.traced.only_blocks).before
        fit_surface(EnvironmentTerms(lit.bank, lit.traced, model, o, fit.seed, gathered), stage)
        # an instance with a guessed azimuth contributes no texture
        seen = shown_faces(lit.instances, pile.with_known_turn, lit.cameras)
        environment, ground = model.environment.image(), ground_colour(shots[0][0], pile.plane)
        if pile.plane is not None:
            up, level = camera.world_from_camera[:3, :3] @ pile.plane[1], ground
            ground = ground_reflectance(environment, up, level)
            environment = light_below(environment, up, level)
        return PileMaterial(
            **texels.material_maps(model.material, seen),
            environment=environment,
            ground_colour=ground,
        )

    title = "material and light (surface pass)"
    return fit.run.cached("surface", PileMaterial, computed, steps=o.steps, title=title)


def pile_material_start(
    lit: LitPile, pile: PlacedPile, texels: TexelMap, stage, fit: FitContext
) -> SurfaceModel:
    """The material and light that the surface pass begins with."""
    run, options, o, known = fit.run, fit.options, pile_surface_options(fit.options), texels.known
    begun, metallic = TexelStart(texels.spread(pile.base), known, lit.level), PAINT
    if "first_material" not in options.without and stage.load("checkpoint") is None:
        progress = run.progress("metal or paint")
        metallic, _ = first_material(lit.bank, lit.traced, begun, o, fit.seed, progress)
        run.say(f"{(metallic[known] > 0.5).mean():.0%} of the surface begins as metal")
    model = start_surface(begun, o, metallic)
    if options.gaussians:
        level = max(lit.level, 1e-4) / ALBEDO_START
        model.gaussians = GaussianLight(options.gaussians, o.light, level)
    return model


def shown_faces(instances: Mesh, which: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(F,) bool: faces of the object that some camera sees, not all too aslant, on one of the
    instances `which` (K,) bool. instances: all K, one after the other."""
    seen = seen_faces(instances, cameras, ASLANT)
    return seen.reshape(len(which), -1)[which].any(0)


@dataclass(frozen=True)
class TurnedPoses:
    """poses: (K, 4, 4) object_from_first_photo of all instances."""

    poses: np.ndarray


def turns_stage(
    asset: Asset, pile: PlacedPile, views: list[InstanceView], camera: Camera, fit: FitContext
) -> PlacedPile:
    """The pile with the guessed turns of instances as the photo shows them."""
    title = "turns about the axis"
    turned = fit.run.cached(
        "turns",
        TurnedPoses,
        lambda stage: TurnedPoses(turned_poses(asset, pile, views, camera, fit)),
        title=title,
    )
    return replace(pile, poses=turned.poses)


def turned_poses(
    asset: Asset, pile: PlacedPile, views: list[InstanceView], camera: Camera, fit: FitContext
) -> np.ndarray:
    """See `turns_stage`: (K, 4, 4)."""
    run, poses = fit.run, pile.poses.copy()
    axis = body_axis(pile.mesh)
    guessed = [v for v in views if v.id in pile.guessed and v.id in pile.ids]
    if axis is None or not guessed:
        return poses
    own = [pile.ids.index(v.id) for v in guessed]
    cameras = [
        v.camera.with_pose(camera.world_from_camera @ pile.motions[v.photo]) for v in guessed
    ]
    before = poses[own] @ camera.camera_from_world
    progress = run.progress("turns about the axis", SCENES)
    after = turned_as_shown(asset, guessed, cameras, before, axis, fit.seed, progress)
    for view, a, b in zip(guessed, before, after, strict=True):
        turn = rotation_angle(a[:3, :3].T @ b[:3, :3])
        run.say(
            f"the object with {instance_name(view)}, rendered, differs least from the photo when it is turned by {turn:.0f} degrees"
        )
    poses[own] = after @ camera.world_from_camera
    return poses


# ---------------------------------------------------------------- asset


def assemble(photos, pile: PlacedPile, maps: PileMaterial, found: PilePoses) -> Asset:
    """The asset: the object +Y up where a ground was found (as the first instance stands), its
    instances in the user's world, whose unit is the unit of the fit (one photo does not know the
    scale)."""
    world_from_photo = photos[0].camera.world_from_camera
    world_from_unit = [world_from_photo @ np.linalg.inv(p) for p in pile.poses]
    up = np.array([0.0, 1.0, 0.0])
    if pile.plane is not None:
        up = world_from_photo[:3, :3] @ pile.plane[1]
    # the instance whose own axes are turned least stands for all
    asset_from_unit = similarity(
        nearest_rotation(
            rotation_from(world_from_unit[0][:3, :3].T @ up, np.array([0.0, 1.0, 0.0]))
        ),
        np.zeros(3),
    )
    placed = replace(
        pile.mesh,
        vertices=move_points(asset_from_unit, pile.mesh.vertices).astype(np.float32),
        normals=(pile.mesh.normals @ asset_from_unit[:3, :3].T).astype(np.float32),
    )
    world_from_object = [m @ np.linalg.inv(asset_from_unit) for m in world_from_unit]
    ground = None
    if pile.plane is not None:
        point = move_points(world_from_photo, pile.plane[0])
        reach = max(np.linalg.norm(m[:3, 3] - point) for m in world_from_object) + 1.0
        ground = Ground(point, up, 4 * float(reach), maps.ground_colour)
    cameras = tuple(
        (p.name, p.camera.with_pose(world_from_photo @ motion))
        for p, motion, known in zip(photos, pile.motions, pile.related, strict=True)
        if known
    )
    return Asset(
        placed,
        Material(maps.base_color, maps.roughness, maps.metallic, normal=maps.normal),
        world_from_object[0],
        maps.environment,
        cameras,
        {},
        None,
        instances=listed_instances(pile, world_from_object, found),
        ground=ground,
    )


def listed_instances(
    pile: PlacedPile, world_from_object: list[np.ndarray], found: PilePoses
) -> tuple[Instance, ...]:
    """All instances, with the reason where a pose is missing or uncertain."""
    out = []
    for name, turn, chance in zip(found.ids, found.turns, found.chances, strict=True):
        if name in pile.ids:
            doubt = (
                f"ambiguous: turned by {turn:.0f} degrees it agrees about as well" if turn else ""
            )
            if name in pile.guessed:
                doubt = "ambiguous: its turn about the axis of the object is a guess"
            pose = world_from_object[pile.ids.index(name)]
            known = float(chance) if np.isfinite(chance) else None
            out.append(Instance(name.label, pose, doubt, name.photo, known))
        elif name not in pile.views and pile.related[name.photo]:
            reason = "it agrees too little with the model of the others"
            out.append(Instance(name.label, None, reason, name.photo))
    return tuple(out)


RECIPE = Recipe(
    name="duplicates",
    light="several identical objects under one light are assumed (duplicates)",
    options=options_for,
    run=reconstruct,
    stages=("poses", "joint", "vessel", "volume", "mesh", "surface", "turns"),
    # most of it is the search for poses
    cost={"draft": (240.0, 1.9e9), "standard": (540.0, 2.0e9), "high": (1500.0, 3.0e9)},
    finds_cameras=True,
    min_photos=1,
    object_cost=ObjectCost(measured_with=10, seconds=0.02, memory=0.008),
    ablations=WITHOUT,
)
