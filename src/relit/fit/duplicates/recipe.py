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

from dataclasses import replace

import numpy as np

from relit.capture.networks import Network, predicted_normals
from relit.conventions import move_points, similarity
from relit.errors import UserError
from relit.fit.duplicates.azimuth_refinement import SCENES, turned_as_shown
from relit.fit.duplicates.ground_paint import ground_as_shown
from relit.fit.duplicates.indirect_light import ASLANT, HiddenLight, hidden_from
from relit.fit.duplicates.lit_pile import lit_pile, pile_surface_options
from relit.fit.duplicates.options import WITHOUT, DuplicatesOptions, options_for
from relit.fit.duplicates.poses import all_views, instance_name, poses_stage
from relit.fit.duplicates.scene import ground_colour, ground_reflectance, light_below
from relit.fit.duplicates.shape import shape_stages
from relit.fit.duplicates.vessels import body_axis
from relit.fit.passes.first_material import PAINT, first_material
from relit.fit.passes.material_priors import ALBEDO_START
from relit.fit.passes.surface import EnvironmentTerms, fit_surface, start_surface
from relit.fit.registration.instances.views import ANOTHER_PHOTO, InstanceView
from relit.fit.shape.inpaint import painted_over
from relit.fit.shape.unseen import seen_faces
from relit.geometry.bake import fill_gutters, interpolate, rasterise_atlas
from relit.geometry.se3 import nearest_rotation, rotation_angle, rotation_from
from relit.lighting.gaussian_light import GaussianLight
from relit.materials.field import normal_map, pictures
from relit.recipe import FitContext, ObjectCost, Recipe
from relit.rendering.transport import NO_TEXELS
from relit.run import run_arrays
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
    poses, registered, keys, unsure, axes = poses_stage(shots, run, options, seed)
    on_axes = {int(k): p for k, p, one in zip(keys, poses, axes, strict=True) if one}
    shown = [v for v in all_views(shots, options.side, options) if v.key in keys]
    views, others = (
        [v for v in shown if (v.key in keys[registered]) == placed] for placed in (True, False)
    )
    poses = poses[registered]
    if run.done("mesh"):
        parts = run_arrays(run, "mesh", "mesh")
    else:
        parts = shape_stages(shots, views, poses, others, on_axes, fit)
    mesh = Mesh(parts["vertices"], parts["faces"], parts["normals"], parts["uvs"])
    camera = photos[0].camera
    maps = (
        run_arrays(run, "surface", "maps")
        if run.done("surface")
        else surface_stage(shots, camera, mesh, parts, fit)
    )
    doubts = dict(zip(keys.tolist(), unsure.tolist(), strict=True))
    asset = assemble(photos, mesh, maps, parts, doubts)
    if len(parts.get("vague", ())):
        parts = parts | {"poses": turns_stage(asset, mesh, shown, camera, parts, run, seed)}
        asset = assemble(photos, mesh, maps, parts, doubts)
    return ground_as_shown(asset, shots[0][0], seed)


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


def surface_stage(
    shots, camera: Camera, mesh: Mesh, parts, fit: FitContext
) -> dict[str, np.ndarray]:
    """Material and light, in the scene frame: the world's axes, unit lengths of the object, the
    origin in the middle of the pile. What no instance shows is painted like what is next to it.
    Returns (and keeps) base_color, roughness, metallic, normal, environment and ground_colour."""
    run, options, seed = fit.run, fit.options, fit.seed
    o = pile_surface_options(options)
    with run.stage("surface", steps=o.steps, title="material and light (surface pass)") as stage:
        up = camera.world_from_camera[:3, :3] @ parts["plane"][1] if len(parts["plane"]) else None
        ground_level = ground_colour(shots[0][0], parts["plane"])
        lit = lit_pile(
            shots, camera, mesh, parts, options.max_pixels, alone="visibility" in options.without
        )
        bank, traced, level = lit.bank, lit.traced, lit.level
        face, bary = rasterise_atlas(mesh, o.texture)
        known = face >= 0
        start = fill_gutters(interpolate(parts["base"], mesh.faces, face, bary), known)
        metallic = PAINT
        if "first_material" not in options.without and stage.load("checkpoint") is None:
            # metal alone: each texel stands in many places under the light here, so that roughness
            # finds its way from anywhere
            progress = run.progress("metal or paint")
            metallic, _ = first_material(
                bank, traced, start, known, level, None, o, seed, progress, dullness=False
            )
            run.say(f"{(metallic[known] > 0.5).mean():.0%} of the surface begins as metal")
        model = start_surface(start, known, level, o, None, metallic)
        if options.gaussians:
            model.gaussians = GaussianLight(
                options.gaussians, o.light, max(level, 1e-4) / ALBEDO_START
            )
        gathered = None
        if "hidden" not in options.without and not lit.alone:
            gathered = HiddenLight(
                traced, hidden_from(traced, lit.cameras), traced.mesh.uvs[:, 0] < NO_TEXELS
            ).before
        fit_surface(EnvironmentTerms(bank, traced, model, o, seed, gathered), stage)
        names = ("base_color", "roughness", "metallic")
        paint = {
            n: fill_gutters(t, known) for n, t in zip(names, pictures(model.material), strict=True)
        }
        told = parts["view_instances"][
            ~np.isin(parts["view_keys"], parts.get("vague", ()))
        ]  # who is turned by guess paints nothing
        which = np.isin(np.arange(len(parts["poses"])), told)
        paint = painted_over(mesh, shown_faces(lit.pile, which, lit.cameras), paint, face, bary)
        environment = model.environment.image()
        ground = ground_level
        if up is not None:
            ground = ground_reflectance(environment, up, ground_level)
            environment = light_below(environment, up, ground_level)
        maps = {
            **paint,
            "normal": normal_map(model.material),
            "environment": environment,
            "ground_colour": ground,
        }
        stage.save("maps", **maps)
    return maps


def shown_faces(pile: Mesh, which: np.ndarray, cameras: list[Camera]) -> np.ndarray:
    """(F,) bool: faces of the object that some camera sees, not all too aslant, on one of the
    instances `which` (K,) bool. All K come first in the pile."""
    seen = seen_faces(pile, cameras, ASLANT)
    instances = (pile.uvs[pile.faces[:, 0], 0] > NO_TEXELS).sum()
    return seen[:instances].reshape(len(which), -1)[which].any(0)


def turns_stage(
    asset: Asset, mesh: Mesh, views: list[InstanceView], camera: Camera, parts, run, seed: int
) -> np.ndarray:
    """Poses (K, 4, 4) of all instances as in `parts`, with those that were turned by guess as the
    photo shows them."""
    if run.done("turns"):
        return run_arrays(run, "turns", "turns")["poses"]
    poses, keys = parts["poses"].copy(), parts["keys"].tolist()
    with run.stage("turns", title="turns about the axis") as stage:
        axis, guessed = (
            body_axis(mesh),
            [v for v in views if v.key in parts["vague"] and v.key in keys],
        )
        if axis is not None and guessed:
            own = [keys.index(v.key) for v in guessed]
            cameras = [
                v.camera.with_pose(camera.world_from_camera @ parts["motions"][v.photo])
                for v in guessed
            ]
            before = poses[own] @ camera.camera_from_world
            after = turned_as_shown(
                asset,
                guessed,
                cameras,
                before,
                axis,
                seed,
                run.progress("turns about the axis", SCENES),
            )
            for view, a, b in zip(guessed, before, after, strict=True):
                turn = rotation_angle(a[:3, :3].T @ b[:3, :3])
                run.say(
                    f"the object with {instance_name(view)}, rendered, differs least from the photo when it is turned by {turn:.0f} degrees"
                )
            poses[own] = after @ camera.world_from_camera
        stage.save("turns", poses=poses)
    return poses


# ---------------------------------------------------------------- asset


def assemble(photos, mesh: Mesh, maps, parts, keys: dict[int, float]) -> Asset:
    """The asset: the object +Y up where a ground was found (as the first instance stands), its
    instances in the user's world, whose unit is the unit of the fit (one photo does not know the
    scale). keys: of the instances, each with the degrees by which it may be turned as well, or
    0."""
    world_from_photo = photos[0].camera.world_from_camera
    world_from_unit = [world_from_photo @ np.linalg.inv(p) for p in parts["poses"]]
    plane = parts["plane"]
    up = world_from_photo[:3, :3] @ plane[1] if len(plane) else np.array([0.0, 1.0, 0.0])
    # the instance whose own axes are turned least stands for all
    asset_from_unit = similarity(
        nearest_rotation(
            rotation_from(world_from_unit[0][:3, :3].T @ up, np.array([0.0, 1.0, 0.0]))
        ),
        np.zeros(3),
    )
    placed = replace(
        mesh,
        vertices=move_points(asset_from_unit, mesh.vertices).astype(np.float32),
        normals=(mesh.normals @ asset_from_unit[:3, :3].T).astype(np.float32),
    )
    world_from_object = [m @ np.linalg.inv(asset_from_unit) for m in world_from_unit]
    instances = []
    placed_keys, shown = parts["keys"].tolist(), parts["view_keys"].tolist()
    for key, other in keys.items():
        if key in placed_keys:
            doubt = (
                f"ambiguous: turned by {other:.0f} degrees it agrees about as well" if other else ""
            )
            if key in parts.get("vague", ()):
                doubt = "ambiguous: its turn about the axis of the object is a guess"
            instances.append(Instance(key, world_from_object[placed_keys.index(key)], doubt))
        elif key not in shown and (key < ANOTHER_PHOTO or parts["related"][key // ANOTHER_PHOTO]):
            instances.append(
                Instance(key, None, "it agrees too little with the model of the others")
            )
    ground = None
    if len(plane):
        point = move_points(world_from_photo, plane[0])
        reach = max(np.linalg.norm(m[:3, 3] - point) for m in world_from_object) + 1.0
        ground = Ground(point, up, 4 * float(reach), maps["ground_colour"])
    material = Material(
        maps["base_color"], maps["roughness"], maps["metallic"], normal=maps["normal"]
    )
    cameras = tuple(
        (p.name, p.camera.with_pose(world_from_photo @ motion))
        for p, motion, known in zip(photos, parts["motions"], parts["related"], strict=True)
        if known
    )
    return Asset(
        placed,
        material,
        world_from_object[0],
        maps["environment"],
        cameras,
        {},
        None,
        instances=tuple(instances),
        ground=ground,
    )


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
