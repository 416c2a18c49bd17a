"""The process that renders with Blender's Cycles: the only file that imports `bpy` (GPL-3.0).

    PYTHON cycles_worker.py JOB.json

It runs under an interpreter that has bpy and NumPy and needs nothing else of Relit. JOB.json is
written by `relit.synthesize.cycles`; it names the arrays and textures of one scene. Each line of
the standard input is then one view as JSON, {"pose", "lens", "shift", "aspect", "size", "samples",
"seed", "out"}; the answer is one line `RELIT done` after `out` (OpenEXR, linear RGBA, premultiplied
on black) is written. The process ends with its input.

Everything is in Blender's axes (z up); Cycles computes in linear Rec.709.
"""

import json
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Python puts the script's folder first, where modules would hide those of Blender (`cycles`).
sys.path = [p for p in sys.path if Path(p or ".").resolve() != HERE]

import bpy  # pyright: ignore[reportMissingImports]  # noqa: E402
import numpy as np  # noqa: E402

DIFFUSE_ONLY = 0.0  # Diffuse Roughness of Principled: Lambert


def picture(path: str, colour: bool):
    """A texture file as it is stored: 32-bit, linear Rec.709 (`colour`) or data."""
    image = bpy.data.images.load(path)
    image.colorspace_settings.name = "Linear Rec.709" if colour else "Non-Color"
    image.use_half_precision = False  # the default cuts floats to 16 bits
    return image


def make_mesh(arrays) -> "bpy.types.Object":
    """The object of the job's arrays: vertices, faces, normals, uvs (v up)."""
    mesh = bpy.data.meshes.new("object")
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    mesh.update()
    if "uvs" in arrays:
        layer = mesh.uv_layers.new(name="uv")
        corners = arrays["uvs"][arrays["faces"].ravel()]
        layer.data.foreach_set("uv", np.ascontiguousarray(corners, np.float32).ravel())
    mesh.shade_smooth()
    mesh.normals_split_custom_set_from_vertices(arrays["normals"].tolist())
    thing = bpy.data.objects.new("object", mesh)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def make_material(job: dict) -> "bpy.types.Material":
    """Principled BSDF with the job's constants and textures."""
    material = bpy.data.materials.new("material")
    if material.node_tree is None:  # Blender before 5.0
        material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    shader = nodes.new("ShaderNodeBsdfPrincipled")
    shader.distribution = job["distribution"]
    shader.inputs["IOR"].default_value = job["ior"]
    shader.inputs["Diffuse Roughness"].default_value = DIFFUSE_ONLY
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(shader.outputs["BSDF"], output.inputs["Surface"])
    for name, value in job["constants"].items():
        shader.inputs[name].default_value = value
    for name, file in job["textures"].items():
        texture = nodes.new("ShaderNodeTexImage")
        texture.image = picture(file, name in ("Base Color", "Specular Tint"))
        texture.extension, texture.interpolation = "REPEAT", "Linear"
        if name == "Normal":
            normal = nodes.new("ShaderNodeNormalMap")
            normal.space, normal.uv_map = "TANGENT", "uv"
            links.new(texture.outputs["Color"], normal.inputs["Color"])
            links.new(normal.outputs["Normal"], shader.inputs["Normal"])
        else:
            links.new(texture.outputs["Color"], shader.inputs[name])
    return material


def make_world(file: str) -> None:
    """The lat-long map as the light of the scene."""
    world = bpy.data.worlds.new("world")
    if world.node_tree is None:
        world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    texture = nodes.new("ShaderNodeTexEnvironment")
    texture.image = picture(file, True)
    texture.projection, texture.interpolation = "EQUIRECTANGULAR", "Linear"
    background = nodes.new("ShaderNodeBackground")
    output = nodes.new("ShaderNodeOutputWorld")
    links.new(texture.outputs["Color"], background.inputs["Color"])
    links.new(background.outputs["Background"], output.inputs["Surface"])
    bpy.context.scene.world = world


def settings(job: dict) -> None:
    """An unbiased estimate: no clamp, no denoiser, no filter of glossy paths, all caustics."""
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    c = scene.cycles
    c.device, c.use_adaptive_sampling, c.use_denoising = "CPU", False, False
    c.sample_clamp_direct = c.sample_clamp_indirect = 0.0
    c.light_sampling_threshold, c.blur_glossy = 0.0, 0.0
    c.caustics_reflective = c.caustics_refractive = True
    c.pixel_filter_type = "BOX"
    c.max_bounces = c.diffuse_bounces = c.glossy_bounces = job["bounces"]
    c.transmission_bounces = c.volume_bounces = 0
    c.use_animated_seed = False
    r = scene.render
    r.film_transparent, r.use_persistent_data, r.resolution_percentage = True, True, 100
    r.use_file_extension = r.use_compositing = r.use_sequencer = False
    if hasattr(r.image_settings, "media_type"):
        r.image_settings.media_type = "IMAGE"
    r.image_settings.file_format, r.image_settings.color_mode = "OPEN_EXR", "RGBA"
    r.image_settings.color_depth, r.image_settings.exr_codec = "32", "ZIP"
    scene.display_settings.display_device = "sRGB"
    scene.view_settings.view_transform = "Raw"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    camera.data.sensor_fit, camera.data.sensor_width = "HORIZONTAL", job["sensor"]
    camera.data.clip_start, camera.data.clip_end = 1e-3, 1e4


def render_view(view: dict) -> None:
    """One view into its file."""
    scene = bpy.context.scene
    camera = scene.camera
    camera.matrix_world = np.asarray(view["pose"]).T.tolist()  # by columns
    camera.data.lens = view["lens"]
    camera.data.shift_x, camera.data.shift_y = view["shift"]
    r = scene.render
    r.resolution_x, r.resolution_y = view["size"]
    r.pixel_aspect_x, r.pixel_aspect_y = view["aspect"]
    scene.cycles.samples, scene.cycles.seed = view["samples"], view["seed"]
    r.filepath = view["out"]
    bpy.ops.render.render(write_still=True)


def serve(file: str) -> None:
    job = json.loads(Path(file).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    settings(job)
    with np.load(job["arrays"], allow_pickle=False) as arrays:
        thing = make_mesh({name: arrays[name] for name in arrays.files})
    thing.data.materials.append(make_material(job))
    make_world(job["light"])
    print(f"RELIT ready {bpy.app.version_string}", flush=True)
    for line in sys.stdin:
        render_view(json.loads(line))
        print("RELIT done", flush=True)


if __name__ == "__main__":
    serve(sys.argv[1])
